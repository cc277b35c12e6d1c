/* ---- demands and distances ------------------------------------------------------------------ */

/* Correction of the pose with the timestamp `pose_t_ns`. The first eleven fields lie as in sf_output. */
typedef struct sf_demand {
  int64_t t_ns;      /* when the service computed it */
  int64_t pose_t_ns; /* timestamp of the pose it refers to; 0: none */
  double demand[6];  /* x y z [m], rx ry rz [rad]; all zero unless sf_dev_vector returned SF_OK */
  int64_t status;    /* SF_VALID, SF_NO_POSE, ... and SF_STALE */
  int64_t cycle;
  int64_t epoch;
  int64_t age_ns; /* time since t_ns */
} sf_demand;

#define SF_DEMAND_WORDS 11
SF_STATIC_ASSERT(offsetof(sf_demand, t_ns) == offsetof(sf_output, t_ns), "sf_demand must lie as sf_output");
SF_STATIC_ASSERT(offsetof(sf_demand, demand) == offsetof(sf_output, demand), "sf_demand must lie as sf_output");
SF_STATIC_ASSERT(offsetof(sf_demand, status) == offsetof(sf_output, status), "sf_demand must lie as sf_output");
SF_STATIC_ASSERT(offsetof(sf_demand, epoch) == offsetof(sf_output, epoch), "sf_demand must lie as sf_output");
SF_STATIC_ASSERT(offsetof(sf_demand, age_ns) == 8 * SF_DEMAND_WORDS, "sf_demand must lie as sf_output");

/* The newest demand without looking for a restarted service: no system call but the clock's. */
static inline int sf_i_demand(const sf_client *c, sf_demand *d, int64_t *now_ns) {
  const int64_t g = sf_latch_read_part(c->output, sizeof(sf_output), 0, SF_DEMAND_WORDS, d);
  if (g <= 0) memset(d, 0, sizeof *d);
  const int64_t now = sf_now_ns();
  *now_ns = now;
  d->age_ns = now - d->t_ns;
  /* a timestamp of the future is of another clock: the age of the demand is unknown */
  if (d->age_ns <= c->stale_ns && d->age_ns >= -c->stale_ns && g > 0 && !c->ended) {
    if (d->status & SF_VALID) return SF_OK;
  } else {
    d->status = (d->status & ~SF_CAST(int64_t, SF_VALID)) | SF_STALE;
  }
  memset(d->demand, 0, sizeof d->demand);
  return SF_NO_DEMAND;
}

/*
 * The newest demand. SF_OK: valid; SF_NO_DEMAND: all six numbers are zero, `status` says why (SF_STALE:
 * the service is silent, dead or gone). Never waits; while stale it looks for a restarted service every
 * 20 ms, unless the options forbid it. On an error the demand is zero and stale too.
 */
static inline int sf_dev_vector(sf_client *c, sf_demand *d) {
  if (d == NULL) return SF_ERR_ARGUMENT;
  if (c == NULL || c->output == NULL) {
    memset(d, 0, sizeof *d);
    d->status = SF_STALE;
    return SF_ERR_ARGUMENT;
  }
  int64_t now;
  const int result = sf_i_demand(c, d, &now);
  if (d->status & SF_STALE) sf_i_reattach_sometimes(c, now);
  return result;
}

/* Whether the service publishes now: 1 or 0; looks for a restarted one as sf_dev_vector does. */
static inline int sf_alive(sf_client *c) {
  if (c == NULL || c->output == NULL) return 0;
  const int64_t now = sf_now_ns();
  if (!sf_i_is_silent(c, now)) return 1;
  sf_i_reattach_sometimes(c, now);
  return !sf_i_is_silent(c, now);
}

/*
 * Everything the newest cycle published. SF_OK, SF_NO_READING (no cycle yet), SF_ERR_TORN, or
 * SF_ERR_NOT_RUNNING: the service ended; one that stands still leaves its last words, see their `t_ns`.
 */
static inline int sf_read_output(sf_client *c, sf_output *output) {
  if (c == NULL || c->output == NULL || output == NULL) return SF_ERR_ARGUMENT;
  if (sf_i_follow(c, sf_now_ns()) != SF_OK) return SF_ERR_NOT_RUNNING;
  const int64_t g = sf_latch_read(c->output, sizeof *output, output);
  return g > 0 ? SF_OK : g == 0 ? SF_NO_READING : SF_ERR_TORN;
}

static inline int sf_i_is_finite(double value) {
  uint64_t bits; /* not isfinite: -ffast-math makes it always true */
  memcpy(&bits, &value, 8);
  return (bits >> 52 & 0x7FFu) != 0x7FFu;
}

/*
 * The newest smoothed sensor-to-target distance of a channel [m].
 * SF_OK; SF_NO_READING: none valid, or the service is stale (`*range_m` is NaN then).
 */
static inline int sf_raw_distance(sf_client *c, int channel, double *range_m) {
  if (c == NULL || c->output == NULL || range_m == NULL || channel < 0 || channel >= SF_CHANNELS)
    return SF_ERR_ARGUMENT;
  const uint64_t nan_bits = 0x7FF8000000000000u;
  memcpy(range_m, &nan_bits, 8);
  sf_demand d;
  sf_dev_vector(c, &d);
  if (d.status & SF_STALE) return SF_NO_READING;
  double value;
  const size_t at = offsetof(sf_output, range_m) + 8 * SF_CAST(size_t, channel);
  if (sf_latch_read_part(c->output, sizeof(sf_output), at, 1, &value) <= 0) return SF_NO_READING;
  if (!sf_i_is_finite(value)) return SF_NO_READING;
  *range_m = value;
  return SF_OK;
}

