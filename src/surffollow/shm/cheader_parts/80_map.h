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

static inline int sf_i_map_request(sf_client *c, int64_t code, const double region[4]) {
  if (c == NULL || region == NULL) return SF_ERR_ARGUMENT;
  if (!sf_i_region_ok(region)) return SF_ERR_REGION;
  return sf_i_request(c, code, 4, NULL, region, 6 * c->options.timeout_ns);
}

/* Clear the map and lay it over a region x_min, y_min, x_max, y_max [m] (paper: MapReset). */
static inline int sf_map_reset(sf_client *c, const double region[4]) {
  return sf_i_map_request(c, SF_RQ_MAP_RESET, region);
}

/* Lay the map over another region, keeping known heights (paper: MapRefocus). */
static inline int sf_map_refocus(sf_client *c, const double region[4]) {
  return sf_i_map_request(c, SF_RQ_MAP_REFOCUS, region);
}

/* The map's header, or NULL: not mapped, of another release, or not a map. */
static inline const sf_map_header *sf_i_map(const sf_client *c) {
  if (c->map.memory == NULL || c->map.size < sizeof(sf_map_header)) return NULL;
  const sf_map_header *h = SF_VIEW(const sf_map_header *, c->map.memory);
  return h->magic == SF_MAP_MAGIC && h->layout_hash == SF_MAP_LAYOUT_HASH ? h : NULL;
}

/* Whether so many grids lie inside the mapped object. */
static inline int sf_i_map_holds(const sf_client *c, int64_t nx, int64_t ny) {
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
 * SF_OK; SF_UNKNOWN: nobody has been there, it is beside the map, or the map is being laid anew.
 */
static inline int sf_map_height(const sf_client *c, double x_m, double y_m, double *height_m) {
  if (c == NULL || c->output == NULL || height_m == NULL) return SF_ERR_ARGUMENT;
  const sf_map_header *h = sf_i_map(c);
  if (h == NULL) return SF_ERR_BLOCK;
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

/* ---- exclusive access: the paper's four steps ------------------------------------------------ */

/* Whether this client holds the map now: 1 or 0. */
static inline int sf_access_held(const sf_client *c) {
  sf_map_status s;
  if (c == NULL || c->output == NULL || c->slot < 0) return 0;
  if (sf_latch_read(c->map_status, sizeof s, &s) <= 0) return 0;
  return s.access == SF_ACCESS_GRANTED && s.access_slot == c->slot;
}

static inline void sf_i_post_access(sf_client *c, int64_t flag) {
  sf_store_release(&SF_VIEW(sf_slot_head *, c->slot_memory + SF_SLOT_HEAD)->access, flag);
}

/*
 * Ask for the map to stand still, and wait until it does (steps 1, 2). Following goes on; samples and
 * map requests queue up. End it with sf_access_end within the service's lease (30 s by default).
 */
static inline int sf_access_begin(sf_client *c, int64_t timeout_ns) {
  if (c == NULL || c->output == NULL) return SF_ERR_ARGUMENT;
  if (c->options.observe) return SF_ERR_OBSERVER;
  if (c->slot_memory == NULL || !sf_alive(c)) sf_i_reattach_sometimes(c, sf_now_ns());
  if (c->slot_memory == NULL || !sf_alive(c)) return SF_ERR_NOT_RUNNING;
  const int64_t deadline = sf_now_ns() + timeout_ns;
  sf_i_post_access(c, SF_ACCESS_REQUESTED); /* 1 */
  while (!sf_access_held(c)) {              /* 2 is the service's */
    const int alive = sf_alive(c);
    if (!alive || sf_now_ns() > deadline) {
      sf_i_post_access(c, SF_ACCESS_FREE);
      return alive ? SF_ERR_TIMEOUT : SF_ERR_NOT_RUNNING;
    }
    sf_sleep_until_ns(sf_now_ns() + 200000);
  }
  return SF_OK;
}

/*
 * Let the map go on (steps 3, 4). SF_ERR_ACCESS_LOST: the lease was over or the service restarted before
 * this call, so what was read may be mixed.
 */
static inline int sf_access_end(sf_client *c) {
  if (c == NULL || c->output == NULL) return SF_ERR_ARGUMENT;
  if (c->slot_memory == NULL) return SF_ERR_ACCESS_LOST;
  const int held = sf_access_held(c);
  const int64_t deadline = sf_now_ns() + c->options.timeout_ns;
  sf_i_post_access(c, SF_ACCESS_DONE);                                        /* 3 */
  while (sf_access_held(c) && sf_alive(c) && sf_now_ns() < deadline)          /* 4 is the service's */
    sf_sleep_until_ns(sf_now_ns() + 200000);
  if (!held) sf_sleep_until_ns(sf_now_ns() + 5000000); /* the service must see that the flag came down */
  sf_i_post_access(c, SF_ACCESS_FREE);
  return held ? SF_OK : SF_ERR_ACCESS_LOST;
}

