/* One call of surffollow.h per line of stdin; one line of answer each: result, detail, values. */
#include "surffollow.h"

#include <signal.h>
#include <sys/time.h>

static sf_client client;
static sf_ticket ticket;
static sf_options options;

static void ignore(int number) { (void)number; }

/* signals at 2 kHz that interrupt system calls */
static void interrupt_often(void) {
  struct sigaction action;
  memset(&action, 0, sizeof action);
  action.sa_handler = ignore; /* without SA_RESTART */
  sigaction(SIGALRM, &action, NULL);
  struct itimerval every;
  every.it_interval.tv_sec = every.it_value.tv_sec = 0;
  every.it_interval.tv_usec = every.it_value.tv_usec = 500;
  setitimer(ITIMER_REAL, &every, NULL);
}

static int answer(const char *verb, char *rest) {
  double v[8] = {0};
  int n = 0;
  char word[512] = "";
  sscanf(rest, "%500s", word);
  for (char *p = rest; n < 8; n++) {
    char *end;
    v[n] = strtod(p, &end);
    if (end == p) break;
    p = end;
  }
  if (strcmp(verb, "attach") == 0) return sf_attach_with(&client, word, &options);
  if (strcmp(verb, "observe") == 0) {
    options.observe = 1;
    return sf_attach_with(&client, word, &options);
  }
  if (strcmp(verb, "auto") == 0) return options.auto_reattach = (int)v[0], 0;
  if (strcmp(verb, "owner") == 0) return options.owner = (int64_t)v[0], 0;
  if (strcmp(verb, "stale_ms") == 0) return options.stale_min_ns = (int64_t)(v[0] * 1e6), 0;
  if (strcmp(verb, "stale_of") == 0) { /* periods, least age [ns], period [ns] */
    sf_options o = sf_default_options();
    o.stale_periods = (int64_t)v[0];
    o.stale_min_ns = (int64_t)v[1];
    printf("%" PRId64 " ", sf_i_stale_ns(&o, (int64_t)v[2]));
    return 0;
  }
  if (strcmp(verb, "ready_ms") == 0) return options.ready_wait_ns = (int64_t)(v[0] * 1e6), 0;
  if (strcmp(verb, "timeout_ms") == 0) return options.timeout_ns = (int64_t)(v[0] * 1e6), 0;
  if (strcmp(verb, "detach") == 0) return sf_detach(&client), 0;
  if (strcmp(verb, "forget") == 0) return sf_forget(&client), 0;
  if (strcmp(verb, "fork") == 0) {
    const pid_t child = fork();
    if (child == 0) {
      sf_forget(&client);
      sf_sleep_until_ns(sf_now_ns() + (int64_t)(v[0] * 1e6));
      _exit(0);
    }
    return child > 0 ? 0 : SF_ERR_SYSTEM;
  }
  if (strcmp(verb, "reattach") == 0) return sf_reattach(&client);
  if (strcmp(verb, "claim") == 0) return sf_claim_pose(&client);
  if (strcmp(verb, "release") == 0) return sf_release_pose(&client);
  if (strcmp(verb, "ee") == 0) return sf_ee_pos(&client, v, SF_NOW);
  if (strcmp(verb, "ee_at") == 0) return sf_ee_pos(&client, v, sf_now_ns() + (int64_t)v[7]);
  if (strcmp(verb, "push") == 0) return sf_push_range(&client, (int)v[0], sf_now_ns() + (int64_t)v[2], v[1]);
  if (strcmp(verb, "push_none") == 0) return sf_push_range(&client, (int)v[0], SF_NOW, sf_no_reading());
  if (strcmp(verb, "claim_range") == 0) return sf_claim_range(&client, (int)v[0]);
  if (strcmp(verb, "release_range") == 0) return sf_release_range(&client, (int)v[0]);
  if (strcmp(verb, "stop") == 0) return sf_stop(&client, word[0] != '\0' ? word : NULL);
  if (strcmp(verb, "stop_now") == 0) return sf_stop_now(&client);
  if (strcmp(verb, "send_and_stop") == 0) {
    const int sent = sf_request_send(&client, (int64_t)v[0], 1, NULL, &v[1], &ticket);
    return sent != SF_OK ? sent : sf_stop(&client, "at once");
  }
  if (strcmp(verb, "stop_reset") == 0) return sf_stop_reset(&client);
  if (strcmp(verb, "sim") == 0) return sf_sim_pose(&client, sf_now_ns(), v, NULL);
  if (strcmp(verb, "reset") == 0) return sf_sf_reset(&client, v[0]);
  if (strcmp(verb, "set") == 0) {
    const char *name = strtok(rest, " ");
    const char *value = strtok(NULL, " ");
    return name != NULL && value != NULL ? sf_set_param(&client, name, strtod(value, NULL)) : SF_ERR_ARGUMENT;
  }
  if (strcmp(verb, "get") == 0) {
    const int result = sf_get_param(&client, word, &v[0]);
    printf("%.17g ", v[0]);
    return result;
  }
  if (strcmp(verb, "params") == 0) {
    sf_params p;
    const int result = sf_read_params(&client, &p);
    printf("%" PRId64 " ", result == SF_OK ? p.range_size : 0);
    return result;
  }
  if (strcmp(verb, "output") == 0) {
    static sf_output o;
    const int result = sf_read_output(&client, &o);
    printf("%" PRId64 " ", result == SF_OK ? o.epoch : 0);
    return result;
  }
  if (strcmp(verb, "map_reset") == 0) return sf_map_reset(&client, v);
  if (strcmp(verb, "map_refocus") == 0)
    return v[4] > 0.0 ? sf_map_refocus_to(&client, v, v[4]) : sf_map_refocus(&client, v);
  if (strcmp(verb, "upload") == 0) return sf_upload_map(&client, word);
  if (strcmp(verb, "height") == 0) {
    double height = 0.0;
    const int result = sf_map_height(&client, v[0], v[1], &height);
    printf("%.17g ", height);
    return result;
  }
  if (strcmp(verb, "surface") == 0) {
    double s[3] = {0.0, 0.0, 0.0};
    const int result = sf_map_surface(&client, v[0], v[1], &s[0], &s[1], &s[2]);
    printf("%.17g %.17g %.17g ", s[0], s[1], s[2]);
    return result;
  }
  if (strcmp(verb, "begin") == 0) return sf_access_begin(&client, (int64_t)(v[0] * 1e6));
  if (strcmp(verb, "end") == 0) return sf_access_end(&client);
  if (strcmp(verb, "held") == 0) return sf_access_held(&client);
  if (strcmp(verb, "holding") == 0) { /* begin, wait v[1] ms, end */
    const int begun = sf_access_begin(&client, (int64_t)(v[0] * 1e6));
    if (begun != SF_OK) return begun;
    sf_sleep_until_ns(sf_now_ns() + (int64_t)(v[1] * 1e6));
    return sf_access_end(&client);
  }
  if (strcmp(verb, "alive") == 0) return sf_alive(&client);
  if (strcmp(verb, "dev") == 0) {
    sf_demand d;
    const int result = sf_dev_vector(&client, &d);
    printf("%.17g %.17g %" PRId64 " %" PRId64 " %" PRId64 " ", d.demand[2], d.demand[0] + d.demand[5], d.status,
           d.epoch, d.age_ns);
    return result;
  }
  if (strcmp(verb, "raw") == 0) {
    double range = 0.0;
    const int result = sf_raw_distance(&client, (int)v[0], &range);
    printf("%.17g ", range);
    return result;
  }
  if (strcmp(verb, "status") == 0) {
    sf_status_info s;
    const int result = sf_status(&client, &s);
    printf("%d %" PRId64 " %" PRId64 " %" PRId64 " %" PRId64 " %" PRId64 " %" PRId64 " ", s.alive, s.pid, s.cycles,
           s.ticker.pose_pid, s.map.applied, s.ticker.clients, s.poses);
    return result;
  }
  if (strcmp(verb, "send") == 0) return sf_request_send(&client, (int64_t)v[0], 1, NULL, &v[1], &ticket);
  if (strcmp(verb, "poll") == 0) return sf_request_poll(&client, &ticket);
  if (strcmp(verb, "wait") == 0) return sf_request_wait(&client, &ticket, (int64_t)(v[0] * 1e6));
  if (strcmp(verb, "interrupt") == 0) return interrupt_often(), 0;
  return 99;
}

int main(void) {
  char line[1024];
  options = sf_default_options();
  options.label = "probe";
  client.slot = -1;
  for (;;) {
    if (fgets(line, sizeof line, stdin) == NULL) {
      if (feof(stdin)) break;
      clearerr(stdin); /* a signal came between */
      continue;
    }
    line[strcspn(line, "\n")] = '\0';
    char *rest = strchr(line, ' ');
    if (rest != NULL) *rest++ = '\0';
    char nothing[1] = "";
    const int result = answer(line, rest != NULL ? rest : nothing);
    printf("%d %" PRId64 " %d\n", result, client.detail, client.slot);
    fflush(stdout);
  }
  sf_detach(&client);
  return 0;
}
