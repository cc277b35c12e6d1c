/* The client of the lower priority, in C: drives forward whenever nobody else has the cart.
 *
 *     cc -std=c11 -I"$(surffollow --includedir)" -o patrol patrol.c && ./patrol cell 10
 */
#include "surffollow_arbiter.h"

int main(int argc, char **argv) {
  const double forward[2] = {0.4, 0.0};
  sfa_client patrol;
  sfa_resource_status status;
  int64_t end, sent = 0;
  int robot, err, granted = 0;
  if (argc < 3) return 2;
  err = sfa_attach(&patrol, argv[1], "patrol", 10000); /* waits for a server that starts */
  if (err < 0) {
    fprintf(stderr, "patrol: %s\n", sfa_strerror(err));
    return 1;
  }
  robot = sfa_resource(&patrol, "robot");
  if (robot < 0) return 1;
  end = sf_now_ns() + (int64_t)(atof(argv[2]) * 1e9);
  while (sf_now_ns() < end) {
    if (sfa_ended(&patrol) && sfa_reattach(&patrol, 200) != 0) { /* to an arbiter of the same user only */
      sf_sleep_until_ns(sf_now_ns() + 20000000);
      continue;
    }
    if (sfa_command(&patrol, robot, forward, 2) == 1)
      sent++;
    else if (sfa_request(&patrol, robot, 1, 200, NULL) == 1) /* stand in the queue for 0.2 s */
      granted++;
    sf_sleep_until_ns(sf_now_ns() + 10000000);
  }
  if (!sfa_ended(&patrol) && sfa_status(&patrol, robot, &status))
    printf("patrol was granted the cart %d times and sent %lld commands; %lld were forwarded in all\n", granted,
           (long long)sent, (long long)status.forwarded);
  sfa_detach(&patrol);
  return 0;
}
