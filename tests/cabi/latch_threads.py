"""Compilers and threads of the latch tests."""

from __future__ import annotations

# one thread publishes, two read and look at every word
THREADS = """
#include "surffollow.h"
#include <pthread.h>
static _Alignas(64) int64_t latch[8 + 4 * 16];
static int over;
static int64_t seen;
static void *write_all(void *unused) {
  int64_t payload[16];
  const int64_t end_ns = sf_now_ns() + 30000000000; /* on a busy machine the readers come late */
  for (int64_t n = 1; n <= 60000 || sf_now_ns() < end_ns; n++) {
    if (n > 60000 && __atomic_load_n(&seen, __ATOMIC_RELAXED) >= 1000) break;
    for (int k = 0; k < 16; k++) payload[k] = n;
    sf_latch_write(latch, sizeof payload, payload);
  }
  __atomic_store_n(&over, 1, __ATOMIC_RELEASE);
  return unused;
}
static void *read_all(void *counts) {
  int64_t payload[16], *count = (int64_t *)counts;
  while (!__atomic_load_n(&over, __ATOMIC_ACQUIRE)) {
    const int64_t g = sf_latch_read(latch, sizeof payload, payload);
    if (g <= 0) continue;
    count[0]++;
    __atomic_fetch_add(&seen, 1, __ATOMIC_RELAXED);
    for (int k = 0; k < 16; k++) count[1] += payload[k] != g;
  }
  return NULL;
}
int main(void) {
  int64_t counts[2][2] = {{0, 0}, {0, 0}};
  pthread_t threads[3];
  pthread_create(&threads[1], NULL, read_all, counts[0]);
  pthread_create(&threads[2], NULL, read_all, counts[1]);
  pthread_create(&threads[0], NULL, write_all, NULL);
  for (int k = 0; k < 3; k++) pthread_join(threads[k], NULL);
  const int64_t reads = counts[0][0] + counts[1][0], torn = counts[0][1] + counts[1][1];
  printf("reads %" PRId64 " torn %" PRId64 "\\n", reads, torn);
  return 0;
}
"""


AARCH64 = "aarch64-linux-gnu-gcc"
