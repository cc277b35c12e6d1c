"""Limits of a pose, for every program that reports or takes one."""

MAX_POSITION_M = 1e9  # farther out no sum or product of ours is exact, or finite
NORM_TOLERANCE = 1e-3  # of the norm of a quaternion, from 1
