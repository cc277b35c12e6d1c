/* Ask the header for what a client does wrong, or meets: one line for each answer. */
#include "surffollow_arbiter.h"

int main(int argc, char **argv) {
  const double two[3] = {0.1, 0.2, 0.3}, pose[7] = {1, 2, 3, 0, 0, 0, 1};
  const double *last;
  sfa_client a;
  sfa_resource_status status;
  int robot, k, got = 1;
  if (argc < 2 || sfa_attach(&a, argv[1], "go", 5000) != 0) return 1;
  robot = sfa_resource(&a, "robot");
  printf("request %d\n", sfa_request(&a, robot, 0, 5000, NULL));
  printf("two %d\n", sfa_command(&a, robot, two, 2));
  printf("one %d\n", sfa_command(&a, robot, two, 1));
  printf("three %d\n", sfa_command(&a, robot, two, 3));
  printf("nowhere %d %d %d %d %d\n", sfa_command(&a, -22, two, 2), sfa_held(&a, -22) != 0, sfa_asked(&a, 99),
         sfa_status(&a, -1, &status), sfa_relinquish(&a, 99));
  printf("undated %d\n", sfa_command_at(&a, robot, two, 2, 0, pose));
  for (k = 0; k < 2 * SFA_MAILBOX_ITEMS; k++) /* every place of the mailbox: with a pose, then without */
    while (sfa_command_at(&a, robot, two, 2, 7, k < SFA_MAILBOX_ITEMS ? pose : NULL) != 1)
      sf_sleep_until_ns(sf_now_ns() + 1000000);
  last = SF_VIEW(const double *, a.mailbox + offsetof(sfa_mailbox, item) + offsetof(sfa_item, ref_pose));
  printf("left %d\n", last[0] != 0.0 || last[6] != 0.0);
  printf("ready\n");
  fflush(stdout);
  /* the server is killed meanwhile; one that gets no processor time for a while takes nothing from the mailbox */
  for (k = 0; k < 5000 && (got == 1 || got == -EAGAIN); k++) {
    got = sfa_command(&a, robot, two, 2);
    sf_sleep_until_ns(sf_now_ns() + 10000000);
  }
  printf("ended %d %d\n", got, k < 5000);
  sfa_detach(&a);
  return 0;
}
