/*
 * Times the C client for tools/bench_ipc.py.
 *
 *     ipc_timing calls NAME BATCHES     ns per call, p50 and p99 of batches of 64 calls
 *     ipc_timing push NAME BATCHES      the same of sf_push_range, stamped by its own look at the clock
 *     ipc_timing handover NAME POSES    ns from sf_ee_pos to the demand that refers to it, one by one
 */
#include "surffollow.h"

#define BATCH 64
#define MOST 1000000

static double sample[MOST];

static int ascending(const void *a, const void *b) {
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

static void report(const char *what, int n) {
  qsort(sample, (size_t)n, sizeof sample[0], ascending);
  printf("%s_p50_ns %.1f %s_p99_ns %.1f ", what, sample[n / 2], what, sample[(int)(n * 0.99)]);
}

static const double pose[7] = {0.05, 0.05, 0.1, 0.0, 0.0, 0.0, 1.0};

static int calls(sf_client *c, int n) {
  sf_demand d;
  double sum = 0.0;
  for (int k = 0; k < n; k++) {
    const int64_t start = sf_now_ns();
    for (int i = 0; i < BATCH; i++) {
      sf_dev_vector(c, &d);
      sum += d.demand[2];
    }
    sample[k] = (double)(sf_now_ns() - start) / BATCH;
  }
  report("dev_vector", n);
  for (int k = 0; k < n; k++) {
    const int64_t start = sf_now_ns();
    for (int i = 0; i < BATCH; i++) sf_ee_pos(c, pose, SF_NOW);
    sample[k] = (double)(sf_now_ns() - start) / BATCH;
  }
  report("ee_pos", n);
  for (int k = 0; k < n; k++) {
    const int64_t start = sf_now_ns();
    for (int i = 0; i < BATCH; i++) sum += (double)sf_now_ns();
    sample[k] = (double)(sf_now_ns() - start) / BATCH;
  }
  report("clock", n);
  printf("sum %.0f\n", sum * 0.0);
  return 0;
}

static int push(sf_client *c, int n) {
  if (sf_claim_range(c, 0) != SF_OK) return 5;
  for (int k = 0; k < n; k++) {
    const int64_t start = sf_now_ns();
    for (int i = 0; i < BATCH; i++)
      if (sf_push_range(c, 0, SF_NOW, 0.1) != SF_OK) return 6;
    sample[k] = (double)(sf_now_ns() - start) / BATCH;
  }
  report("push", n);
  printf("n_push %d\n", n);
  return 0;
}

static int handover(sf_client *c, int n) {
  sf_demand d;
  for (int k = 0; k < n; k++) {
    /* at random times within the service's period */
    sf_sleep_until_ns(sf_now_ns() + 300000 + rand() % 100000);
    const int64_t t_ns = sf_now_ns();
    if (sf_ee_pos(c, pose, t_ns) != SF_OK) return 2;
    do {
      sf_dev_vector(c, &d);
      if (sf_now_ns() - t_ns > 1000000000) return 3;
    } while (d.pose_t_ns != t_ns);
    sample[k] = (double)(sf_now_ns() - t_ns);
  }
  report("handover", n);
  printf("n %d\n", n);
  return 0;
}

int main(int argc, char **argv) {
  sf_client c;
  const int n = argc == 4 ? (int)strtol(argv[3], NULL, 10) : 0;
  if (n < 100 || n > MOST || sf_attach(&c, argv[2]) != SF_OK) return 1;
  if (argv[1][0] == 'p') {
    const int pushed = push(&c, n);
    sf_detach(&c);
    return pushed;
  }
  const int64_t patience = sf_now_ns() + 5000000000;
  while (sf_claim_pose(&c) != SF_OK) { /* a busy machine may keep the service silent for a moment */
    if (sf_now_ns() > patience) return 4;
    sf_sleep_until_ns(sf_now_ns() + 10000000);
  }
  const int result = argv[1][0] == 'c' ? calls(&c, n) : handover(&c, n);
  sf_detach(&c);
  return result;
}
