/* A random number that no other attachment has; 62 bits, odd. */
static inline int64_t sf_i_random_claim(void) {
  uint64_t r = 0;
  ssize_t got = -1;
  const int fd = open("/dev/urandom", O_RDONLY | O_CLOEXEC);
  if (fd >= 0) {
    do {
      got = read(fd, &r, sizeof r);
    } while (got < 0 && errno == EINTR);
    close(fd);
  }
  if (got != SF_CAST(ssize_t, sizeof r))
    r = (SF_CAST(uint64_t, sf_now_ns()) * 0x9E3779B97F4A7C15u) ^ (SF_CAST(uint64_t, getpid()) << 32);
  return SF_CAST(int64_t, (r >> 2) | 1u);
}

/* Whether the process that was started then still has memory: one that dies gives that up first. */
static inline int sf_i_is_running(int64_t pid, int64_t start_ticks) {
  char path[40], text[1024];
  snprintf(path, sizeof path, "/proc/%" PRId64 "/stat", pid);
  const int fd = open(path, O_RDONLY | O_CLOEXEC);
  if (fd < 0) return 0;
  const ssize_t got = read(fd, text, sizeof text - 1);
  close(fd);
  if (got <= 0) return 0;
  text[got] = '\0';
  const char *p = strrchr(text, ')'); /* a program's name may hold anything */
  for (int field = 0; p != NULL && field < 20; field++) p = strchr(p + 1, ' ');
  char *end;
  if (p == NULL || strtoll(p, &end, 10) != start_ticks) return 0; /* field 22 */
  return strtoull(end, NULL, 10) > 0;
}

/* Whether the service, which fell silent, ended; one that stands still keeps our connection, and is a process. */
static inline int sf_i_has_ended(const sf_client *c) {
  const sf_board_header *h = SF_VIEW(const sf_board_header *, c->board.memory);
  if (!sf_i_is_current(c, "", &c->board)) return 1;
  if (c->slot_memory != NULL) return !sf_i_slot_is_open(c);
  return !sf_i_is_running(h->pid, h->start_ticks);
}

static inline void sf_i_read_pose_timeout(sf_client *c) {
  int64_t value;
  const size_t at = offsetof(sf_params, pose_timeout_ns);
  c->pose_timeout_ns = 100000000;
  if (sf_latch_read_part(c->params, sizeof(sf_params), at, 1, &value) > 0 && value > 0) c->pose_timeout_ns = value;
}

static inline void sf_i_give_pose_back(sf_client *c);

static inline void sf_i_detach(sf_client *c, int remove_world) {
  sf_i_release_slot(c);
  sf_i_release_world(c, remove_world);
  c->access_depth = 0;
  sf_i_close(&c->board);
  sf_i_close(&c->map);
  c->output = c->params = c->acks = c->map_acks = c->ticker = c->map_status = c->stats = NULL;
}

/*
 * Release the pose, give back the slot, remove the world block of sf_sim_pose, unmap everything. Also right after a
 * failed attach, and of a client of zeroes that was never attached. The pose is not lost, so SF_STOP_POSE_LOST latches no stop. It waits for the service's answer to the
 * release, 1 s at most, and not for a service that is silent.
 */
static inline void sf_detach(sf_client *c) {
  if (c == NULL) return;
  sf_i_give_pose_back(c);
  sf_i_detach(c, 1);
}

/*
 * Let go of a client without a release. For a child after fork(), before it does anything else with surffollow:
 * the child would otherwise write into its parent's slot. In the process that attached, the pose counts as
 * lost: for the end of a program that failed.
 */
static inline void sf_forget(sf_client *c) {
  if (c == NULL) return;
  sf_i_detach(c, 0);
}

/*
 * Attach to a running service, in `ready_wait_ns` and SF_SLOT_WAIT_NS at most. `options` NULL: the defaults. The client needs no initialisation;
 * attaching one that is attached leaks.
 * SF_OK, SF_ERR_ARGUMENT, _NAME, _NOT_RUNNING, _NO_PERMISSION, _NOT_READY, _LAYOUT, _BLOCK, _SLOTS, _OWNER,
 * _SYSTEM.
 */
static inline int sf_attach_with(sf_client *c, const char *name, const sf_options *options) {
  if (c == NULL) return SF_ERR_ARGUMENT;
  memset(c, 0, sizeof *c);
  c->slot = -1;
  sf_i_forget(&c->board);
  sf_i_forget(&c->held);
  c->asking.fd = -1;
  c->owner = -1;
  sf_i_forget(&c->map);
  sf_i_forget(&c->world);
  c->options = options != NULL ? *options : sf_default_options();
  c->options.ready_wait_ns = sf_i_wait_ns(c->options.ready_wait_ns);
  c->options.timeout_ns = sf_i_wait_ns(c->options.timeout_ns);
  if (c->options.stale_periods < 1 || c->options.owner < SF_OWNER_DEFAULT) return SF_ERR_ARGUMENT;
  if (c->options.stale_min_ns < 0 || c->options.stale_min_ns > SF_STALE_LONGEST_NS) return SF_ERR_ARGUMENT;
  if (name == NULL || !sf_i_name_ok(name)) return SF_ERR_NAME;
  memcpy(c->name, name, strlen(name));
  const char *label = c->options.label;
  if (label == NULL)
    snprintf(c->label, sizeof c->label, "C %ld", SF_CAST(long, getpid()));
  else
    memcpy(c->label, label, strlen(label) < sizeof c->label - 1 ? strlen(label) : sizeof c->label - 1);
  c->options.label = NULL; /* the caller's memory may go */
  int err = sf_i_open_board(c, c->options.ready_wait_ns);
  const int64_t began = sf_now_ns(), deadline = began + SF_SLOT_WAIT_NS;
  while (err == SF_OK && !c->options.observe && (err = sf_i_claim_slot(c, deadline)) == SF_ERR_NOT_READY &&
         sf_now_ns() < (sf_i_has_ended(c) ? began + c->options.ready_wait_ns : deadline)) {
    /* the service was replaced between our looks at its board and at its socket */
    sf_sleep_until_ns(sf_now_ns() + 5000000);
    err = sf_i_is_current(c, "", &c->board) ? SF_OK : sf_i_open_board(c, c->options.ready_wait_ns);
  }
  if (err != SF_OK) {
    if (err == SF_ERR_NOT_READY && c->board.memory != NULL && sf_i_has_ended(c)) err = SF_ERR_NOT_RUNNING;
    sf_detach(c);
    return err;
  }
  sf_i_read_pose_timeout(c);
  return SF_OK;
}

/* Attach as a client that may send poses and requests; results as sf_attach_with. SF_ERR_NOT_READY: the service
 * starts; call it again. */
static inline int sf_attach(sf_client *c, const char *name) { return sf_attach_with(c, name, NULL); }

/* sf_attach, trusting no service but that of user number `owner`. */
static inline int sf_attach_owner(sf_client *c, const char *name, uid_t owner) {
  sf_options o = sf_default_options();
  o.owner = SF_CAST(int64_t, owner);
  return sf_attach_with(c, name, &o);
}

/* Attach read-only: no slot, no write permission. */
static inline int sf_observe(sf_client *c, const char *name) {
  sf_options o = sf_default_options();
  o.observe = 1;
  return sf_attach_with(c, name, &o);
}

/* Go over to a newer service's board; its slot is asked for when it is needed. */
static inline int sf_i_reattach_board(sf_client *c) {
  if (!sf_i_is_current(c, "", &c->board)) {
    const int err = sf_i_open_board(c, 0);
    if (err != SF_OK) return err;
    sf_i_release_slot(c);
  }
  sf_i_read_pose_timeout(c);
  return SF_OK;
}

/*
 * Look for a newer service of this name. SF_OK: attached to the current one; the pose must be claimed
 * anew, which the next calls of sf_ee_pos do. It may wait SF_SLOT_WAIT_NS for a slot, other calls never do. Otherwise the error, and the old attachment stays; SF_ERR_OWNER:
 * what bears the name now belongs to another user (`detail`) than the service attached to first.
 */
static inline int sf_reattach(sf_client *c) {
  if (c == NULL || c->board.memory == NULL) return SF_ERR_ARGUMENT;
  const int err = sf_i_reattach_board(c);
  if (err != SF_OK || c->options.observe || c->slot_memory != NULL) return err;
  return sf_i_claim_slot(c, sf_now_ns() + SF_SLOT_WAIT_NS);
}

/* Look for a newer service and for an end of this one, at most every 20 ms. */
static inline void sf_i_look_again(sf_client *c, int64_t now_ns) {
  if (now_ns < c->next_attach_ns) return;
  c->next_attach_ns = now_ns + SF_REATTACH_EVERY_NS;
  if (c->options.auto_reattach) sf_i_reattach_board(c);
  c->ended = sf_i_has_ended(c);
  /* purged: the mapped map is without an owner */
  if (c->map.memory != NULL && !sf_i_is_current(c, ".map", &c->map)) sf_i_close(&c->map);
}

/* sf_i_look_again if the options allow it. */
static inline void sf_i_reattach_sometimes(sf_client *c, int64_t now_ns) {
  if (c->options.auto_reattach) sf_i_look_again(c, now_ns);
}

/* Whether nothing was published for so long, or nothing at all, or the service is known to have ended. */
static inline int sf_i_is_silent(const sf_client *c, int64_t now_ns) {
  int64_t t_ns;
  if (c->ended) return 1;
  if (sf_latch_read_part(c->output, sizeof(sf_output), offsetof(sf_output, t_ns), 1, &t_ns) <= 0) return 1;
  return now_ns - t_ns > c->stale_ns || t_ns - now_ns > c->stale_ns;
}

/* Follow a silent service to its new start. SF_ERR_NOT_RUNNING: it ended, and there is no other. */
static inline int sf_i_follow(sf_client *c, int64_t now_ns) {
  if (!sf_i_is_silent(c, now_ns)) return SF_OK;
  sf_i_look_again(c, now_ns);
  return c->ended ? SF_ERR_NOT_RUNNING : SF_OK;
}

