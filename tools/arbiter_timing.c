/* Times of an arbiter's client in C, beside a Unix socket between two such processes, in turns.
 *
 *     arbiter_timing NAME CLIENT ROUNDS CPU
 *
 * CPU: the processor of the socket's other end, as it is the server's.
 * Prints: socket p50 p99, grant p50 p99 [ns], command p50 of batches [ns], commands forwarded per second. */
#define _GNU_SOURCE
#include "surffollow_arbiter.h"

#include <sched.h>
#include <signal.h>
#include <sys/wait.h>

#define BATCH 32

static int by_size(const void *a, const void *b) {
  const int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;
  return (x > y) - (x < y);
}

static void tell(const char *what, int64_t *times, size_t n) {
  qsort(times, n, sizeof *times, by_size);
  printf("%s_p50_ns %lld %s_p99_ns %lld ", what, (long long)times[n / 2], what, (long long)times[n * 99 / 100]);
}

int main(int argc, char **argv) {
  sfa_client a;
  sfa_resource_status before, after;
  const double values[2] = {0.1, 0.2};
  const size_t rounds = argc > 3 ? (size_t)atol(argv[3]) : 0;
  int64_t *sock = malloc(rounds * sizeof *sock), *grant = malloc(rounds * sizeof *grant);
  int64_t *batch = malloc(rounds * sizeof *batch), until, begin;
  int pair[2], robot, err;
  size_t k;
  char byte = 0;
  pid_t echo;
  if (argc < 5 || sock == NULL || grant == NULL || batch == NULL) return 2;
  if (socketpair(AF_UNIX, SOCK_STREAM, 0, pair) != 0) return 2;
  echo = fork();
  if (echo == 0) {
    cpu_set_t set;
    CPU_ZERO(&set);
    CPU_SET(atoi(argv[4]), &set);
    if (sched_setaffinity(0, sizeof set, &set) != 0) _exit(1);
    while (read(pair[1], &byte, 1) == 1)
      if (write(pair[1], &byte, 1) != 1) break;
    _exit(0);
  }
  err = sfa_attach(&a, argv[1], argv[2], 5000);
  if (err < 0) {
    fprintf(stderr, "%s\n", sfa_strerror(err));
    return 1;
  }
  robot = sfa_resource(&a, "robot");
  for (k = 0; k < rounds; k++) {
    begin = sf_now_ns();
    if (write(pair[0], &byte, 1) != 1 || read(pair[0], &byte, 1) != 1) return 1;
    sock[k] = sf_now_ns() - begin;
    begin = sf_now_ns();
    if (sfa_request(&a, robot, 0, 5000, NULL) != 1) return 1;
    grant[k] = sf_now_ns() - begin;
    sfa_relinquish(&a, robot);
  }
  sfa_request(&a, robot, 0, 5000, NULL);
  for (k = 0; k < rounds / 16; k++) {
    int i;
    sf_sleep_until_ns(sf_now_ns() + 2000000);
    begin = sf_now_ns();
    for (i = 0; i < BATCH; i++) sfa_command(&a, robot, values, 2);
    batch[k] = (sf_now_ns() - begin) / BATCH;
  }
  tell("socket", sock, rounds);
  tell("grant", grant, rounds);
  tell("command", batch, rounds / 16);
  sf_sleep_until_ns(sf_now_ns() + 20000000);
  sfa_request(&a, robot, 0, 5000, NULL);
  sfa_status(&a, robot, &before);
  begin = sf_now_ns();
  until = begin + 2000000000;
  while (sf_now_ns() < until) {
    if (sfa_command(&a, robot, values, 2) == -EAGAIN) sf_sleep_until_ns(sf_now_ns() + 100000);
  }
  sf_sleep_until_ns(sf_now_ns() + 20000000);
  sfa_status(&a, robot, &after);
  printf("forwarded_per_s %.0f\n", (double)(after.forwarded - before.forwarded) / ((double)(sf_now_ns() - begin) * 1e-9));
  sfa_detach(&a);
  kill(echo, SIGKILL);
  waitpid(echo, NULL, 0);
  return 0;
}
