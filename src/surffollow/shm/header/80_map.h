/* ---- the map -------------------------------------------------------------------------------- */

static inline int sf_i_region_ok(const double region[4]) {
  for (int k = 0; k < 4; k++)
    if (!sf_i_is_finite(region[k])) return 0;
  for (int k = 0; k < 2; k++) {
    const double side = region[k + 2] - region[k];
    if (!(side > 0.0 && side <= SF_MAX_REGION_M)) return 0;
  }
  return 1;
}

static inline int sf_i_map_request(sf_client *c, int64_t code, const double region[4], double finest_m) {
  if (c == NULL || region == NULL) return SF_ERR_ARGUMENT;
  if (!sf_i_region_ok(region)) return SF_ERR_REGION;
  if (!sf_i_is_finite(finest_m)) return SF_ERR_ARGUMENT;
  if (!(finest_m >= SF_MIN_GRID_M && finest_m <= SF_MAX_GRID_M) && (finest_m < 0.0 || finest_m > 0.0))
    return SF_ERR_ARGUMENT;
  const double values[5] = {region[0], region[1], region[2], region[3], finest_m};
  if (c->access_depth > 0) return SF_ERR_HELD; /* it would wait for this client itself */
  return sf_i_request(c, code, 5, NULL, values, 6 * c->options.timeout_ns);
}

/* Clear the map and lay it over a region x_min, y_min, x_max, y_max [m] (paper: MapReset). */
static inline int sf_map_reset(sf_client *c, const double region[4]) {
  return sf_i_map_request(c, SF_RQ_MAP_RESET, region, 0.0);
}

/* Lay the map over another region, keeping known heights (paper: MapRefocus). */
static inline int sf_map_refocus(sf_client *c, const double region[4]) {
  return sf_i_map_request(c, SF_RQ_MAP_REFOCUS, region, 0.0);
}

/*
 * sf_map_refocus with grids as fine as `finest_m` [m] where memory allows, 1e-6 to 1e4. The grids' size so far keeps
 * them and every height as they are; 0: the service's own choice (map.finest_grid). SF_ERR_ARGUMENT: no such size.
 */
static inline int sf_map_refocus_to(sf_client *c, const double region[4], double finest_m) {
  return sf_i_map_request(c, SF_RQ_MAP_REFOCUS, region, finest_m);
}

/* The map's header, or NULL: not mapped, of another release, or not a map. It outlives a service. */
static inline const sf_map_header *sf_i_map(sf_client *c) {
  sf_i_follow(c, sf_now_ns()); /* the next one's map may be another */
  if (c->map.memory == NULL || c->map.size < SF_MAP_HEADER_BYTES) return NULL;
  const sf_map_header *h = SF_VIEW(const sf_map_header *, c->map.memory);
  return h->magic == SF_MAP_MAGIC && h->layout_hash == SF_MAP_LAYOUT_HASH ? h : NULL;
}

/* Why there is no map's header. */
static inline int sf_i_no_map(const sf_client *c) {
  char path[96];
  struct stat status;
  if (c->map.memory != NULL || !sf_i_path(c->name, ".map", path)) return SF_ERR_BLOCK;
  return lstat(path, &status) != 0 && errno == ENOENT ? SF_ERR_NOT_RUNNING : SF_ERR_BLOCK;
}

/* Whether so many grids lie inside the mapped object. */
static inline int sf_i_map_holds(const sf_client *c, int64_t nx, int64_t ny) {
  if (c->map.size < SF_MAP_HEADER_BYTES) return 0;
  const int64_t room = SF_CAST(int64_t, (c->map.size - SF_MAP_HEADER_BYTES) / sizeof(sf_grid_pair)) * 2;
  return nx > 0 && ny > 0 && nx <= room / ny;
}

static inline double sf_i_load_double(const void *word) {
  const int64_t bits = sf_load_relaxed(word);
  double value;
  memcpy(&value, &bits, 8);
  return value;
}

/*
 * Mean height of the grid that holds a point [m], read from the live map without waiting.
 * SF_OK; SF_UNKNOWN: no sample is there, it is beside the map, or the map is being laid anew.
 */
static inline int sf_map_height(sf_client *c, double x_m, double y_m, double *height_m) {
  if (c == NULL || c->output == NULL || height_m == NULL) return SF_ERR_ARGUMENT;
  const sf_map_header *h = sf_i_map(c);
  if (h == NULL) return sf_i_no_map(c);
  const int64_t generation = sf_load_acquire(&h->generation);
  if (generation & 1 || sf_load_relaxed(&h->state) != SF_MAP_READY) return SF_UNKNOWN;
  const int64_t nx = sf_load_relaxed(&h->nx), ny = sf_load_relaxed(&h->ny);
  const double fx = (x_m - sf_i_load_double(&h->x0_m)) * sf_i_load_double(&h->inv_grid_per_m);
  const double fy = (y_m - sf_i_load_double(&h->y0_m)) * sf_i_load_double(&h->inv_grid_per_m);
  if (!sf_i_map_holds(c, nx, ny) || !(fx >= 0.0 && fx < SF_CAST(double, nx) && fy >= 0.0 && fy < SF_CAST(double, ny)))
    return SF_UNKNOWN;
  const size_t i = SF_CAST(size_t, SF_CAST(int64_t, fy) * nx + SF_CAST(int64_t, fx));
  const sf_grid_pair *pairs = SF_VIEW(const sf_grid_pair *, c->map.memory + SF_MAP_HEADER_BYTES);
  const int16_t quanta = __atomic_load_n(&pairs[i / 2].h[i % 2], __ATOMIC_RELAXED);
  const double height = sf_i_load_double(&h->datum_m) + quanta * sf_i_load_double(&h->quantum_m);
  __atomic_thread_fence(__ATOMIC_ACQUIRE);
  /* the grid belongs to the geometry only if no operation began meanwhile */
  if (sf_load_relaxed(&h->generation) != generation || quanta == SF_MAP_UNKNOWN_HEIGHT) return SF_UNKNOWN;
  *height_m = height;
  return SF_OK;
}

/* One grid's height in quanta; SF_MAP_UNKNOWN_HEIGHT beside the map too. */
static inline int sf_i_quanta(const sf_grid_pair *pairs, int64_t nx, int64_t ny, int64_t ix, int64_t iy) {
  if (ix < 0 || ix >= nx || iy < 0 || iy >= ny) return SF_MAP_UNKNOWN_HEIGHT;
  const size_t i = SF_CAST(size_t, iy * nx + ix);
  return __atomic_load_n(&pairs[i / 2].h[i % 2], __ATOMIC_RELAXED);
}

/* Quanta per grid from the neighbours that are known; NaN without any. */
static inline double sf_i_slope(int own, int before, int after) {
  const uint64_t nan_bits = UINT64_C(0x7FF8000000000000);
  double slope;
  memcpy(&slope, &nan_bits, 8);
  if (before != SF_MAP_UNKNOWN_HEIGHT && after != SF_MAP_UNKNOWN_HEIGHT) return 0.5 * (after - before);
  if (after != SF_MAP_UNKNOWN_HEIGHT) return after - own;
  if (before != SF_MAP_UNKNOWN_HEIGHT) return own - before;
  return slope;
}

/* Bilinear height and slopes at (fx, fy) in grids, in quanta (per grid); 0: the grid there is unknown. */
static inline int sf_i_surface(const sf_grid_pair *pairs, int64_t nx, int64_t ny, double fx, double fy,
                               double surface[3]) {
  const int64_t ix = SF_CAST(int64_t, fx), iy = SF_CAST(int64_t, fy);
  const int own = sf_i_quanta(pairs, nx, ny, ix, iy);
  if (own == SF_MAP_UNKNOWN_HEIGHT) return 0;
  /* the centres around: a point left of its grid's centre lies between it and its left neighbour */
  const int64_t bx = fx - SF_CAST(double, ix) < 0.5 ? ix - 1 : ix;
  const int64_t by = fy - SF_CAST(double, iy) < 0.5 ? iy - 1 : iy;
  const double tx = fx - 0.5 - SF_CAST(double, bx), ty = fy - 0.5 - SF_CAST(double, by);
  double total = 0.0, weight = 0.0;
  for (int k = 0; k < 4; k++) {
    const int dx = k & 1, dy = k >> 1;
    const int q = sf_i_quanta(pairs, nx, ny, bx + dx, by + dy);
    const double part = (dx ? tx : 1.0 - tx) * (dy ? ty : 1.0 - ty);
    if (q == SF_MAP_UNKNOWN_HEIGHT) continue;
    total += part * q;
    weight += part;
  }
  if (!(weight > 0.0)) return 0; /* cleared meanwhile */
  surface[0] = total / weight;
  surface[1] = sf_i_slope(own, sf_i_quanta(pairs, nx, ny, ix - 1, iy), sf_i_quanta(pairs, nx, ny, ix + 1, iy));
  surface[2] = sf_i_slope(own, sf_i_quanta(pairs, nx, ny, ix, iy - 1), sf_i_quanta(pairs, nx, ny, ix, iy + 1));
  return 1;
}

/*
 * Height [m] between grid centres, and slopes dz/dx and dz/dy, at a point [m] of the live map; load-only
 * and bounded, never waits. The grid that holds the point must be known; unknown neighbours leave the
 * bilinear mean. Slopes are central differences, one-sided at the edge of the known, NaN without neighbours.
 * All three are of one geometry of the map; SF_OK; SF_UNKNOWN as in sf_map_height, the results untouched.
 */
static inline int sf_map_surface(sf_client *c, double x_m, double y_m, double *height_m, double *slope_x,
                                 double *slope_y) {
  if (c == NULL || c->output == NULL || height_m == NULL || slope_x == NULL || slope_y == NULL)
    return SF_ERR_ARGUMENT;
  const sf_map_header *h = sf_i_map(c);
  if (h == NULL) return sf_i_no_map(c);
  const sf_grid_pair *pairs = SF_VIEW(const sf_grid_pair *, c->map.memory + SF_MAP_HEADER_BYTES);
  for (int tries = 0; tries < SF_LATCH_MAX_TRIES; tries++) {
    const int64_t generation = sf_load_acquire(&h->generation);
    if (generation & 1 || sf_load_relaxed(&h->state) != SF_MAP_READY || sf_load_acquire(&h->datum_set) == 0)
      return SF_UNKNOWN;
    const int64_t nx = sf_load_relaxed(&h->nx), ny = sf_load_relaxed(&h->ny);
    const double per_m = sf_i_load_double(&h->inv_grid_per_m), quantum_m = sf_i_load_double(&h->quantum_m);
    const double datum_m = sf_i_load_double(&h->datum_m);
    const double fx = (x_m - sf_i_load_double(&h->x0_m)) * per_m;
    const double fy = (y_m - sf_i_load_double(&h->y0_m)) * per_m;
    double s[3] = {0.0, 0.0, 0.0};
    int known = 0;
    if (sf_i_map_holds(c, nx, ny) && fx >= 0.0 && fx < SF_CAST(double, nx) && fy >= 0.0 &&
        fy < SF_CAST(double, ny))
      known = sf_i_surface(pairs, nx, ny, fx, fy, s);
    __atomic_thread_fence(__ATOMIC_ACQUIRE);
    if (sf_load_relaxed(&h->generation) != generation) continue;
    if (!known) return SF_UNKNOWN;
    *height_m = datum_m + quantum_m * s[0];
    *slope_x = s[1] * (quantum_m * per_m);
    *slope_y = s[2] * (quantum_m * per_m);
    return SF_OK;
  }
  return SF_UNKNOWN;
}

/* ---- exclusive access: the paper's four steps ------------------------------------------------ */

/* Whether the service's grant is for this very attachment; a slot's number alone may be a dead client's. */
static inline int sf_i_is_mine(const sf_client *c, const sf_map_status *s) {
  return s->access == SF_ACCESS_GRANTED && s->access_slot == c->slot && s->access_claim == c->claim;
}

/* Whether this client holds the map now, without a break since sf_access_begin: 1 or 0. */
static inline int sf_access_held(sf_client *c) {
  sf_map_status s;
  if (c == NULL || c->output == NULL || c->access_depth < 1) return 0;
  sf_i_follow(c, sf_now_ns());
  if (c->slot < 0) return 0;
  if (sf_latch_read(c->map_status, sizeof s, &s) <= 0) return 0;
  return sf_i_is_mine(c, &s) && s.grants == c->grant;
}

static inline void sf_i_post_access(sf_client *c, int64_t flag) {
  if (c->slot_memory == NULL) return;
  sf_store_release(&SF_VIEW(sf_slot_head *, c->slot_memory + SF_SLOT_HEAD)->access, flag);
}

/* One look for the grant; as long as there is none, ask for it (step 1). */
static inline int sf_i_look_for_grant(sf_client *c) {
  sf_map_status s;
  if (c->slot_memory == NULL || sf_latch_read(c->map_status, sizeof s, &s) <= 0) return 0;
  if (sf_i_is_mine(c, &s) && s.grants != c->grant) {
    c->grant = s.grants;
    return 1;
  }
  /* fenced, or the grant given back last still stands: the flag must be seen to come down first */
  const int down = (s.fenced >> c->slot & 1) != 0 || sf_i_is_mine(c, &s);
  sf_i_post_access(c, down ? SF_ACCESS_FREE : SF_ACCESS_REQUESTED);
  return 0;
}

/*
 * Ask for the map to stand still, and wait until it does (steps 1, 2). Following goes on; samples and
 * map requests queue up. End it with sf_access_end within the service's lease (30 s by default). Calls
 * nest: the map goes on with the last sf_access_end. SF_ERR_ACCESS_LOST: an outer one is lost, end it first.
 */
static inline int sf_access_begin(sf_client *c, int64_t timeout_ns) {
  if (c == NULL || c->output == NULL) return SF_ERR_ARGUMENT;
  if (c->options.observe) return SF_ERR_OBSERVER;
  if (c->access_depth > 0) {
    if (!sf_access_held(c)) return SF_ERR_ACCESS_LOST;
    c->access_depth++;
    return SF_OK;
  }
  const int64_t deadline = sf_now_ns() + sf_i_wait_ns(timeout_ns);
  for (;;) { /* a service that stands still may go on; one that ended has no map to give */
    const int64_t now = sf_now_ns();
    const int alive = sf_alive(c);
    if (alive && sf_i_ensure_slot(c) == SF_OK && sf_i_look_for_grant(c)) break; /* 2 is the service's */
    if (now > deadline || sf_i_follow(c, now) != SF_OK) {
      sf_i_post_access(c, SF_ACCESS_FREE);
      return alive ? SF_ERR_TIMEOUT : SF_ERR_NOT_RUNNING;
    }
    sf_sleep_until_ns(now + 200000);
  }
  c->access_depth = 1;
  return SF_OK;
}

/*
 * Let the map go on (steps 3, 4). SF_ERR_ACCESS_LOST: the lease was over or the service restarted before
 * this call, even if access was granted again since, so what was read may be mixed.
 */
static inline int sf_access_end(sf_client *c) {
  if (c == NULL || c->output == NULL) return SF_ERR_ARGUMENT;
  if (c->access_depth < 1) return SF_ERR_ACCESS_LOST;
  __atomic_thread_fence(__ATOMIC_ACQUIRE); /* what was read was read before this look */
  const int held = sf_access_held(c) && sf_i_is_current(c, "", &c->board);
  if (c->access_depth == 1) {
    const int64_t deadline = sf_now_ns() + c->options.timeout_ns;
    sf_i_post_access(c, SF_ACCESS_DONE);                               /* 3 */
    while (sf_access_held(c) && sf_alive(c) && sf_now_ns() < deadline) /* 4 is the service's */
      sf_sleep_until_ns(sf_now_ns() + 200000);
    sf_i_post_access(c, SF_ACCESS_FREE);
  }
  c->access_depth--;
  return held ? SF_OK : SF_ERR_ACCESS_LOST;
}

