"""Names of the bits in `MainThreadState` that layouts of kernels do not declare; bit k is entry k."""

GRANT_NAMES = ("fifo", "affinity", "mlockall", "dma_latency")
SERVICE_FAULT_NAMES = ("DRIVER", "CYCLE_STALLED", "SAMPLES_LOST", "SLOTS", "HOUSEKEEPING")
FIRST_SERVICE_FAULT = 33  # the follower's faults are numbered from 1, the service's own from here
