/*
 * A robot controller in C: a path over the ground at 100 Hz, whose height follows the service's demands.
 *
 *     surffollow start &
 *     surffollow status --wait 600    # until it is READY
 *     cc -std=c11 -O2 $(surffollow print-header --cflags) -o controller controller.c -lm
 *     ./controller surf 20
 *
 * The arm is a stand-in: an axis that reaches its set point within a speed limit. Put your own
 * read_pose() and move_to() in its place; the rest is what a real controller does. Without a valid demand
 * (stale, in doubt, the stop is latched) it brakes along the path and holds its height: docs/reference/protocol.md, "Stop".
 * The path is a circle of 80 mm between the boxes of the default simulated ground. The stand-off printed is
 * that of the sensor.
 */
#include "surffollow.h"

#include <math.h>
#include <signal.h>

#define TICK_NS 10000000
#define STANDOFF_M 0.1
#define SPEED_MPS 0.05
#define ACCEL_MPS2 0.2 /* along the path: at rest 0.25 s after the tick that missed the demand */
#define CENTRE_X_M 0.937
#define CENTRE_Y_M 0.6
#define RADIUS_M 0.08
/* the path begins when the demand was that small for SETTLED_TICKS */
#define SETTLED_M 0.5e-3
#define SETTLED_TICKS 30

static volatile sig_atomic_t stop;

static void on_signal(int number) {
  (void)number;
  stop = 1;
}

/* A positive time; 0 when it is none. */
static int read_seconds(const char *text, double *seconds) {
  char *end;
  *seconds = strtod(text, &end);
  return end != text && *end == '\0' && *seconds > 0.0 && *seconds <= 1e6;
}

/* ---- the stand-in arm ---- */

static double arm_x_m = CENTRE_X_M + RADIUS_M, arm_y_m = CENTRE_Y_M, arm_z_m = STANDOFF_M;

static void read_pose(double pose[7]) {
  pose[0] = arm_x_m, pose[1] = arm_y_m, pose[2] = arm_z_m;
  pose[3] = pose[4] = pose[5] = 0.0, pose[6] = 1.0;
}

static void move_to(double path_m, double z_m) {
  const double most = 0.2 * TICK_NS * 1e-9; /* 0.2 m/s */
  arm_z_m += fmax(-most, fmin(most, z_m - arm_z_m));
  arm_x_m = CENTRE_X_M + RADIUS_M * cos(path_m / RADIUS_M);
  arm_y_m = CENTRE_Y_M + RADIUS_M * sin(path_m / RADIUS_M);
}

/* ---- the controller ---- */

int main(int argc, char **argv) {
  const char *name = argc > 1 ? argv[1] : "surf";
  double seconds = 20.0;
  const int help = strcmp(name, "--help") == 0 || strcmp(name, "-h") == 0;
  if (help || name[0] == '-' || argc > 4 || (argc > 2 && !read_seconds(argv[2], &seconds))) {
    fprintf(help ? stdout : stderr, "usage: %s [service [seconds [trace.csv]]]; seconds: more than 0, at most 1e6\n",
            argv[0]);
    return help ? 0 : 2;
  }
  struct sigaction action;
  memset(&action, 0, sizeof action);
  action.sa_handler = on_signal;
  sigaction(SIGINT, &action, NULL);
  sigaction(SIGTERM, &action, NULL);

  sf_client robot;
  int result = sf_attach(&robot, name);
  if (result == SF_OK) result = sf_claim_pose(&robot); /* who sends the pose may set parameters */
  if (result == SF_OK) result = sf_sf_reset(&robot, STANDOFF_M);
  if (result != SF_OK) {
    fprintf(stderr, "controller: %s (%" PRId64 ")\n", sf_strerror(result), robot.detail);
    sf_detach(&robot);
    return 1;
  }
  FILE *trace = argc > 3 ? fopen(argv[3], "w") : NULL;
  if (trace != NULL) fprintf(trace, "t_s,x_m,y_m,z_m,range_m,demand_m\n");

  int64_t valid = 0, silent = 0, stopped = 0, refused = 0, worst_age_ns = 0, readings = 0;
  int64_t status = 0; /* of the newest demand */
  int settled = 0, following = 0;
  double set_point_m = STANDOFF_M, path_m = 0.0, speed_mps = 0.0, sum_sq_m2 = 0.0, range_m = -1.0;
  /* where the tool was at the last ticks, for a demand adds to the pose that it names, not to a newer one */
  enum { HISTORY = 64 };
  int64_t sent_ns[HISTORY] = {0};
  double sent_z_m[HISTORY] = {0};
  const int64_t start = sf_now_ns(), ticks = (int64_t)(seconds * 1e9) / TICK_NS;
  for (int64_t k = 0; k < ticks && !stop; k++) {
    double pose[7];
    read_pose(pose);
    const int64_t now = sf_now_ns();
    result = sf_ee_pos(&robot, pose, now);
    if (result != SF_OK) refused++; /* whatever the reason: nothing is followed in this tick */
    sent_ns[k % HISTORY] = now;
    sent_z_m[k % HISTORY] = pose[2];

    /* follow a valid demand; without one, or with one for a pose unknown here: hold the height, brake, stay */
    if (following) set_point_m = pose[2];
    following = 0;
    sf_demand d;
    const int heard = sf_dev_vector(&robot, &d);
    status = d.status;
    if (result == SF_OK && heard == SF_OK) {
      for (int i = 0; i < HISTORY; i++)
        if (sent_ns[i] == d.pose_t_ns) set_point_m = sent_z_m[i] + d.demand[2], following = 1;
      valid++;
      if (d.age_ns > worst_age_ns) worst_age_ns = d.age_ns;
      if (fabs(d.demand[2]) < SETTLED_M) settled++;
    } else if (d.status & SF_STALE) {
      silent++;
    } else if (d.status & SF_STOPPED) {
      stopped++; /* until the one who watches the robot has found out why and calls sf_stop_reset */
    }
    speed_mps += (following && settled >= SETTLED_TICKS ? ACCEL_MPS2 : -ACCEL_MPS2) * TICK_NS * 1e-9;
    speed_mps = speed_mps < 0.0 ? 0.0 : speed_mps > SPEED_MPS ? SPEED_MPS : speed_mps;
    path_m += speed_mps * TICK_NS * 1e-9;
    if (following && speed_mps > 0.0) {
      if (sf_raw_distance(&robot, 0, &range_m) == SF_OK) {
        sum_sq_m2 += (range_m - STANDOFF_M) * (range_m - STANDOFF_M);
        readings++;
      }
      if (trace != NULL)
        fprintf(trace, "%.9g,%.9g,%.9g,%.9g,%.9g,%.9g\n", (double)(now - start) * 1e-9, pose[0], pose[1], pose[2],
                range_m, d.demand[2]);
    }
    move_to(path_m, set_point_m);
    sf_sleep_until_ns(start + (k + 1) * TICK_NS);
  }
  if (trace != NULL) fclose(trace);

  result = sf_raw_distance(&robot, 0, &range_m);
  sf_status_info s;
  sf_status(&robot, &s);
  printf("path_m %.6f speed_mps %.6f stopped %" PRId64 " valid %" PRId64 " stale %" PRId64 " refused %" PRId64 " worst_age_us %" PRId64 " distance_m %.6f z_m %.6f "
         "epoch %" PRId64 " poses %" PRId64 " readings %" PRId64 " standoff_rms_mm %.3f\n",
         path_m, speed_mps, stopped, valid, silent, refused, worst_age_ns / 1000, result == SF_OK ? range_m : -1.0, arm_z_m, robot.epoch, s.poses,
         readings, readings > 0 ? 1e3 * sqrt(sum_sq_m2 / (double)readings) : -1.0);
  sf_detach(&robot);
  if (valid > 0) return 0;
  fprintf(stderr, "controller: no demand was valid:");
  for (int64_t bit = 1; bit <= SF_STALE; bit *= 2)
    if (status & bit) fprintf(stderr, " %s", sf_status_name(bit));
  fprintf(stderr, "; surffollow status --name %s says more\n", name);
  return 1;
}
