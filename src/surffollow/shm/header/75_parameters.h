/* ---- parameters ----------------------------------------------------------------------------- */

/* A parameter by its name, with or without its unit ("max_jerk_mps3", "max_jerk"); NULL when there is none. */
static inline const sf_param_info *sf_find_param(const char *name) {
  static const char *const endings[] = {SF_PARAM_ENDINGS};
  if (name == NULL) return NULL;
  const size_t n = strlen(name);
  for (size_t e = 0; e < sizeof endings / sizeof endings[0]; e++)
    for (int k = 0; k < SF_PARAMS; k++) {
      const sf_param_info *p = &sf_param_table()[k];
      if (strncmp(p->name, name, n) == 0 && strcmp(p->name + n, endings[e]) == 0) return p;
    }
  return NULL;
}

/* All parameters in force. SF_OK, SF_ERR_NOT_READY, SF_ERR_TORN, or SF_ERR_NOT_RUNNING: the service ended. */
static inline int sf_read_params(sf_client *c, sf_params *params) {
  if (c == NULL || c->params == NULL || params == NULL) return SF_ERR_ARGUMENT;
  if (sf_i_follow(c, sf_now_ns()) != SF_OK) return SF_ERR_NOT_RUNNING;
  const int64_t g = sf_latch_read(c->params, sizeof *params, params);
  return g > 0 ? SF_OK : g == 0 ? SF_ERR_NOT_READY : SF_ERR_TORN;
}

/* The value of a parameter in force, in SI units (times in ns). SF_ERR_PARAM, or as sf_read_params. */
static inline int sf_get_param(sf_client *c, const char *name, double *value) {
  if (c == NULL || c->params == NULL || value == NULL) return SF_ERR_ARGUMENT;
  const sf_param_info *p = sf_find_param(name);
  if (p == NULL) return SF_ERR_PARAM;
  if (sf_i_follow(c, sf_now_ns()) != SF_OK) return SF_ERR_NOT_RUNNING;
  int64_t word;
  const int64_t g = sf_latch_read_part(c->params, sizeof(sf_params), SF_CAST(size_t, p->number) * 8, 1, &word);
  if (g <= 0) return g == 0 ? SF_ERR_NOT_READY : SF_ERR_TORN;
  if (p->whole)
    *value = SF_CAST(double, word);
  else
    memcpy(value, &word, 8);
  return SF_OK;
}

/*
 * Change up to SF_REQUEST_ARGS parameters, all or none; in force from the next cycle on. Values are in SI units. Times
 * whose full names end in _ns are in ns, under the short name, too.
 */
static inline int sf_set_params(sf_client *c, int n, const char *const *names, const double *values) {
  int64_t numbers[SF_REQUEST_ARGS];
  if (c == NULL || names == NULL || values == NULL || n < 1 || n > SF_REQUEST_ARGS) return SF_ERR_ARGUMENT;
  for (int k = 0; k < n; k++) {
    const sf_param_info *p = sf_find_param(names[k]);
    if (p == NULL) return SF_ERR_PARAM;
    if (!sf_i_is_finite(values[k]) || !(values[k] >= p->low && values[k] <= p->high)) return SF_ERR_BOUNDS;
    /* bounds of whole parameters are far inside int64 */
    if (p->whole && !(SF_CAST(double, SF_CAST(int64_t, values[k])) >= values[k] &&
                      SF_CAST(double, SF_CAST(int64_t, values[k])) <= values[k]))
      return SF_ERR_BOUNDS;
    numbers[k] = p->number;
  }
  const int result = sf_i_request(c, SF_RQ_SET_PARAMS, n, numbers, values, c->options.timeout_ns);
  c->next_look_ns = c->next_life_ns = 0;
  return result;
}

/* Change one parameter. */
static inline int sf_set_param(sf_client *c, const char *name, double value) {
  return sf_set_params(c, 1, &name, &value);
}

/* ---- status --------------------------------------------------------------------------------- */

typedef sf_main_thread_state sf_ticker; /* the name before release 0.1.0, for one release */

/* How a service is doing. */
typedef struct sf_status_info {
  int alive;                  /* it publishes now */
  int64_t state;              /* SF_STATE_... as last stored */
  int64_t pid, epoch, period_ns;
  int64_t age_ns;             /* of the newest demand */
  int64_t demand_status;      /* SF_VALID, ... */
  int64_t cycles, overruns, skipped, poses, poses_refused, requests, requests_refused, torn;
  int64_t lateness_max_ns, execution_max_ns;
  sf_main_thread_state ticker; /* of the main thread: clients, pose holder, grants, faults, text */
  sf_map_status map;          /* state of the map thread */
} sf_status_info;

/* Ask how the service is doing; also works on a service that has ended. SF_OK or SF_ERR_ARGUMENT. */
static inline int sf_status(sf_client *c, sf_status_info *s) {
  if (c == NULL || c->output == NULL || s == NULL) return SF_ERR_ARGUMENT;
  sf_alive(c); /* which follows it to a new start */
  sf_demand d;
  int64_t now;
  memset(s, 0, sizeof *s);
  sf_i_demand(c, &d, &now);
  const sf_board_header *h = SF_VIEW(const sf_board_header *, c->board.memory);
  const sf_stats *stats = SF_VIEW(const sf_stats *, c->stats);
  s->alive = !(d.status & SF_STALE);
  s->state = sf_load_relaxed(&h->state);
  s->pid = h->pid;
  s->epoch = c->epoch;
  s->period_ns = c->period_ns;
  s->age_ns = d.age_ns;
  s->demand_status = d.status;
  s->cycles = sf_load_relaxed(&stats->cycles);
  s->overruns = sf_load_relaxed(&stats->overruns);
  s->skipped = sf_load_relaxed(&stats->skipped);
  s->poses = sf_load_relaxed(&stats->poses);
  s->poses_refused = sf_load_relaxed(&stats->poses_refused);
  s->requests = sf_load_relaxed(&stats->requests);
  s->requests_refused = sf_load_relaxed(&stats->requests_refused);
  s->torn = sf_load_relaxed(&stats->torn);
  s->lateness_max_ns = sf_load_relaxed(&stats->lateness_max_ns);
  s->execution_max_ns = sf_load_relaxed(&stats->execution_max_ns);
  if (sf_latch_read(c->ticker, sizeof s->ticker, &s->ticker) <= 0) memset(&s->ticker, 0, sizeof s->ticker);
  if (sf_latch_read(c->map_status, sizeof s->map, &s->map) <= 0) memset(&s->map, 0, sizeof s->map);
  s->ticker.text[sizeof s->ticker.text - 1] = '\0';
  return SF_OK;
}

