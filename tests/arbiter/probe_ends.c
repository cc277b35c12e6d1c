/* A client whose process forks, whose server does not answer in time, or is killed: one line for each answer. */
#include "surffollow_arbiter.h"

#include <sys/wait.h>

static void wait_for_a_line(void) {
  while (getchar() != '\n') {
  }
}

int main(int argc, char **argv) {
  const double two[2] = {0.1, 0.2};
  sfa_client a;
  int robot, k, status = 0;
  pid_t child;
  if (argc < 2 || sfa_attach(&a, argv[1], "go", 5000) != 0) return 1;
  robot = sfa_resource(&a, "robot");

  printf("ready\n"); /* the server is stopped */
  fflush(stdout);
  wait_for_a_line();
  printf("request %d\n", sfa_request(&a, robot, 0, 50, NULL));
  fflush(stdout);
  wait_for_a_line(); /* it goes on */
  printf("withdrawn %d\n", sfa_held(&a, robot) == 0);
  printf("again %d\n", sfa_request(&a, robot, 0, 5000, NULL));
  fflush(stdout);

  child = fork();
  if (child == 0) {
    printf("child %d %d %d\n", sfa_held(&a, robot) != 0, sfa_command(&a, robot, two, 2), sfa_relinquish(&a, robot));
    fflush(stdout);
    sfa_heartbeat(&a);
    _exit(0);
  }
  waitpid(child, &status, 0);
  printf("parent %d %d %d\n", status, sfa_held(&a, robot) != 0, sfa_command(&a, robot, two, 2));
  fflush(stdout);

  for (k = 0; k < 1000 && sfa_held(&a, robot) != 0; k++) { /* the server is killed */
    sfa_heartbeat(&a);
    sf_sleep_until_ns(sf_now_ns() + 10000000);
  }
  printf("ended %d %d\n", sfa_held(&a, robot) != 0, sfa_command(&a, robot, two, 2));
  sfa_detach(&a);
  return 0;
}
