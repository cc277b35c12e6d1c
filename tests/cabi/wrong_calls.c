/* Wrong calls of both headers; prints one line per check that failed, then the number of checks. */
#include "surffollow_arbiter.h"

static int checks;

static void check(int holds, const char *what) {
  checks++;
  if (!holds) printf("failed: %s\n", what);
}

#define CHECK(condition) check((condition), #condition)

static int is_open(int fd) { return fcntl(fd, F_GETFD) != -1; }

/* a client in static memory that an error path ends before it was attached */
static void never_attached(void) {
  static sf_client client;
  static sfa_client partner;
  sf_demand demand;
  sf_detach(&client);
  CHECK(is_open(0));
  memset(&client, 0, sizeof client);
  sf_forget(&client);
  CHECK(is_open(0));
  sfa_detach(&partner);
  CHECK(is_open(0));
  CHECK(sf_dev_vector(&client, &demand) == SF_ERR_ARGUMENT && demand.status == SF_STALE);
  CHECK(sf_sf_reset(&client, 0.1) == SF_ERR_ARGUMENT);
}

/* a controller goes on while its arbiter is away */
static void detached_from_an_arbiter(void) {
  const double values[SFA_VALUES] = {0.0};
  sfa_client a;
  sfa_reply reply;
  sfa_resource_status status;
  CHECK(sfa_attach(&a, "", "patrol", 0) == -EINVAL); /* a name that would look like "never attached" */
  CHECK(sfa_attach(&a, "no_arbiter_of_this_name", "patrol", 0) == -ENOENT);
  CHECK(sfa_reattach(&a, 0) == -ENOENT);
  sfa_heartbeat(&a);
  CHECK(sfa_ended(&a) == 1);
  CHECK(sfa_resource(&a, "robot") == -ENOENT);
  CHECK(sfa_held(&a, 0) == 0);
  CHECK(sfa_asked(&a, 0) == 0);
  CHECK(sfa_status(&a, 0, &status) == 0);
  CHECK(sfa_lost_since(&a, 0) == 0);
  CHECK(sfa_command(&a, 0, values, 1) == 0);
  CHECK(sfa_relinquish(&a, 0) == -ENOENT);
  CHECK(sfa_request(&a, 0, 1, 10, &reply) == -ENOENT);
  sfa_detach(&a);
}

/* INT64_MAX as "for ever" */
static void endless(const char *name) {
  const double region[4] = {0.0, 0.0, 1.0, 1.0}, offset_m = 0.1;
  sf_options options = sf_default_options();
  sf_client client;
  sf_ticket ticket;
  options.timeout_ns = options.ready_wait_ns = INT64_MAX;
  CHECK(sf_attach_with(&client, name, &options) == SF_OK);
  CHECK(sf_claim_pose(&client) == SF_OK);
  CHECK(sf_sf_reset(&client, offset_m) == SF_OK);
  CHECK(sf_map_reset(&client, region) == SF_OK);
  CHECK(sf_access_begin(&client, INT64_MAX) == SF_OK);
  CHECK(sf_access_end(&client) == SF_OK);
  CHECK(sf_request_send(&client, SF_RQ_SF_RESET, 1, NULL, &offset_m, &ticket) == SF_OK);
  CHECK(sf_request_wait(&client, &ticket, INT64_MAX) == SF_OK);
  sf_detach(&client);
}

int main(int argc, char **argv) {
  never_attached();
  detached_from_an_arbiter();
  if (argc > 1) endless(argv[1]);
  printf("%d\n", checks);
  return 0;
}
