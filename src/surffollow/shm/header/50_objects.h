/* ---- attachment ----------------------------------------------------------------------------- */

/* A mapped shared-memory object. Private to the functions here. */
typedef struct sf_object {
  unsigned char *memory;
  size_t size;
  uint64_t device, inode;
  uid_t owner;
  int fd; /* of a slot: the connection that owns it; else -1 */
} sf_object;

/* Whose shared memory is trusted: this process's own user, root, and the one that SURFFOLLOW_OWNER names. */
#define SF_OWNER_DEFAULT INT64_C(-1)

/* How to attach; begin with sf_default_options(). */
typedef struct sf_options {
  const char *label;    /* how the service's status names this client; copied */
  int observe;          /* 1: read only; no slot, no write permission needed */
  int auto_reattach;    /* 1: every call looks for a restarted service itself (system calls, every
                           20 ms while stale); 0: call sf_reattach where it suits */
  int64_t stale_periods; /* cycles of silence after which demands become zero: at most SF_STALE_MAX_NS, or
                            SF_STALE_LEAST_PERIODS of them where that is longer ... */
  int64_t stale_min_ns;  /* ... but never sooner than this, which is at most SF_STALE_LONGEST_NS (a day) */
  int64_t ready_wait_ns; /* how long to wait for a service that is starting */
  int64_t timeout_ns;    /* how long a request waits for its answer (map requests: six times this); of all times to
                            wait INT64_MAX means for ever */
  int64_t owner;         /* number of the user whose service to trust, or SF_OWNER_DEFAULT; whose it is at
                            first it must be ever after */
} sf_options;

/* An exchange for a slot, under way in steps that never wait. */
typedef struct sf_i_asking {
  int fd;    /* -1: none */
  int stage; /* 0: to connect, 1: asked, 2: mapped */
  int slot;
  int64_t claim, deadline_ns;
  unsigned char *memory;
} sf_i_asking;

/* A claim of the pose or of a channel that is under way in a slot. */
typedef struct sf_i_claiming {
  int64_t code, channel;
  int64_t counter, claim, asked_ns; /* counter 0: none */
} sf_i_claiming;

/* Another client holds the pose or a channel: a control loop asks again at `until_ns`. */
typedef struct sf_i_refusal {
  int64_t until_ns, pause_ns; /* 0: not refused */
  int64_t pid;
} sf_i_refusal;

/* A client; the caller's memory, filled by sf_attach. Only the first group is for reading. */
typedef struct sf_client {
  int64_t epoch;     /* of the service attached to; changes when it was restarted */
  int64_t period_ns; /* of its cycle */
  int64_t detail;    /* after an error: errno, holder's pid, refused parameter's number */
  int slot;          /* number of the slot it holds; -1: none */
  /* private */
  char name[64];
  char label[32];
  sf_options options;
  sf_object board, held, map; /* held: the slot's memory, and the connection that owns it */
  const unsigned char *output, *params, *acks, *map_acks, *ticker, *map_status, *stats;
  unsigned char *slot_memory;
  int64_t stale_ns, next_attach_ns, next_look_ns, next_life_ns, pose_timeout_ns, pose_held_ns;
  int64_t claim, counter;
  int64_t owner; /* the user whose service it attached to first; -1: not yet */
  int64_t asked_ns;
  int pose_held, abandoned;
  int had_pose, had_ranges; /* what it once held, ranges a bit per channel: claimed anew without waiting */
  sf_i_asking asking;
  sf_i_claiming claiming;
  sf_i_refusal pose_refusal, range_refusals[SF_CHANNELS];
  int ended; /* at the last look the service was silent and its process gone, or its socket refused */
  int64_t grant;    /* number of the newest grant of the map to this attachment */
  int access_depth; /* sf_access_begin that were not ended */
  sf_object world;  /* of sf_sim_pose */
  int64_t next_world_look_ns;
  int ranges_held;                 /* bit per channel */
  int64_t pushed_ns[SF_CHANNELS]; /* time of the newest range of a channel held */
} sf_client;

/*
 * The defaults: a client, re-attaching, stale after min(20 periods, 100 ms) but not before 3 periods and 5 ms,
 * requests wait 5 s.
 */
static inline sf_options sf_default_options(void) {
  sf_options o;
  memset(&o, 0, sizeof o);
  o.auto_reattach = 1;
  o.stale_periods = 20;
  o.stale_min_ns = 5000000;
  o.ready_wait_ns = 2000000000;
  o.timeout_ns = 5000000000;
  o.owner = SF_OWNER_DEFAULT;
  return o;
}

/* A time to wait that no clock's sum with it, nor six times it, exceeds; INT64_MAX means "for ever", too. */
static inline int64_t sf_i_wait_ns(int64_t given_ns) {
  const int64_t longest_ns = INT64_C(1) << 60; /* 36 years */
  return given_ns < 0 ? 0 : given_ns < longest_ns ? given_ns : longest_ns;
}

/* Age at which a demand is stale: docs/reference/protocol.md, "Poses and demands". */
static inline int64_t sf_i_stale_ns(const sf_options *o, int64_t period_ns) {
  const int64_t n = o->stale_periods, least = n < SF_STALE_LEAST_PERIODS ? n : SF_STALE_LEAST_PERIODS;
  int64_t age_ns = n < SF_STALE_MAX_NS / period_ns ? n * period_ns : SF_STALE_MAX_NS;
  if (age_ns < least * period_ns) age_ns = least * period_ns;
  return age_ns < o->stale_min_ns ? o->stale_min_ns : age_ns;
}

static inline int sf_i_name_ok(const char *name) {
  size_t n = 0;
  for (; name[n] != '\0'; n++) {
    const char ch = name[n];
    const int letter = (ch >= 'a' && ch <= 'z') || (ch >= 'A' && ch <= 'Z') || (ch >= '0' && ch <= '9');
    if (!letter && (n == 0 || (ch != '.' && ch != '_' && ch != '-'))) return 0;
    if (n >= 48) return 0;
  }
  /* the names of a service's own objects */
  static const char *const objects[] = {".sock", ".lock", ".map", ".stop", ".world"};
  for (size_t k = 0; k < sizeof objects / sizeof objects[0]; k++) {
    const size_t m = strlen(objects[k]);
    if (n > m && strcmp(name + n - m, objects[k]) == 0) return 0;
  }
  return n > 0;
}

static inline int sf_i_path(const char *name, const char *suffix, char path[96]) {
  const int n = snprintf(path, 96, "/dev/shm/%s%s", name, suffix);
  return n > 0 && n < 96;
}

static inline int sf_i_errno(sf_client *c, int number) {
  c->detail = number;
  if (number == ENOENT) return SF_ERR_NOT_RUNNING;
  if (number == EACCES || number == EPERM) return SF_ERR_NO_PERMISSION;
  /* a link, which is never followed, or a socket or device */
  if (number == ELOOP || number == ENXIO || number == ENODEV || number == EISDIR) return SF_ERR_BLOCK;
  return SF_ERR_SYSTEM;
}

static inline void sf_i_forget(sf_object *o) {
  memset(o, 0, sizeof *o);
  o->fd = -1;
}

static inline void sf_i_close(sf_object *o) {
  if (o->memory != NULL) {
    munmap(o->memory, o->size);
    if (o->fd >= 0) close(o->fd);
  } /* else all zero, perhaps, of a client that was never attached: 0 is no descriptor of ours */
  sf_i_forget(o);
}

/* The number of the user that SURFFOLLOW_OWNER names, by number or name; -1: none. */
static inline int64_t sf_i_configured_owner(void) {
  const char *text = getenv("SURFFOLLOW_OWNER");
  char room[4096], *end;
  struct passwd entry, *found = NULL;
  if (text == NULL || text[0] == '\0') return -1;
  const long long number = strtoll(text, &end, 10);
  if (*end == '\0') return number >= 0 ? SF_CAST(int64_t, number) : -1;
  if (getpwnam_r(text, &entry, room, sizeof room, &found) != 0 || found == NULL) return -1;
  return SF_CAST(int64_t, found->pw_uid);
}

static inline int64_t sf_i_number_in(const char *path, char text[64]) {
  const int fd = open(path, O_RDONLY | O_CLOEXEC);
  ssize_t n = fd < 0 ? -1 : read(fd, text, 63);
  if (fd >= 0) close(fd);
  text[n < 0 ? 0 : n] = '\0';
  return n > 0 ? SF_CAST(int64_t, strtoll(text, NULL, 10)) : -1;
}

/*
 * Whether an object of user `found` is this process's own. In a user namespace that does not map all users the others
 * all have the overflow user's number, and so has this process when it is not mapped itself.
 */
static inline int sf_i_is_own(uid_t found) {
  char text[64];
  unsigned long long inside, outside, count;
  if (found != geteuid()) return 0;
  if (sf_i_number_in("/proc/sys/kernel/overflowuid", text) != SF_CAST(int64_t, found)) return 1;
  sf_i_number_in("/proc/self/uid_map", text);
  return sscanf(text, "%llu %llu %llu", &inside, &outside, &count) == 3 && inside == 0 && outside == 0 &&
         count == 4294967295ULL;
}

/* Whether an object of user `found` is trusted; `owner`: one user's number, or SF_OWNER_DEFAULT. */
static inline int sf_i_owner_ok(int64_t owner, uid_t found) {
  if (owner != SF_OWNER_DEFAULT) return owner == SF_CAST(int64_t, found);
  return found == 0 || sf_i_is_own(found) || SF_CAST(int64_t, found) == sf_i_configured_owner();
}

/*
 * Map NAME + suffix read-only. The name may lead to any kind of file of any user: nothing here waits
 * for it (O_NONBLOCK), follows a link, or maps what is no plain file of a user who is trusted.
 */
static inline int sf_i_open(sf_client *c, const char *suffix, sf_object *o) {
  char path[96];
  struct stat status;
  sf_i_forget(o);
  if (!sf_i_path(c->name, suffix, path)) return SF_ERR_NAME;
  int fd;
  do {
    fd = open(path, O_RDONLY | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK | O_NOCTTY);
  } while (fd < 0 && errno == EINTR);
  if (fd < 0) return sf_i_errno(c, errno);
  if (fstat(fd, &status) != 0) {
    const int number = errno;
    close(fd);
    return sf_i_errno(c, number);
  }
  if (!S_ISREG(status.st_mode)) {
    close(fd);
    return SF_ERR_BLOCK;
  }
  if (!sf_i_owner_ok(c->owner >= 0 ? c->owner : c->options.owner, status.st_uid)) {
    close(fd);
    c->detail = SF_CAST(int64_t, status.st_uid);
    return SF_ERR_OWNER;
  }
  if (status.st_size < SF_PAGE) { /* created, not yet laid out */
    close(fd);
    return SF_ERR_NOT_READY;
  }
  void *memory = mmap(NULL, SF_CAST(size_t, status.st_size), PROT_READ, MAP_SHARED, fd, 0);
  const int number = errno;
  close(fd);
  if (memory == MAP_FAILED) return sf_i_errno(c, number);
  o->memory = SF_CAST(unsigned char *, memory);
  o->size = SF_CAST(size_t, status.st_size);
  o->device = SF_CAST(uint64_t, status.st_dev);
  o->inode = SF_CAST(uint64_t, status.st_ino);
  o->owner = status.st_uid;
  return SF_OK;
}

/* Whether the name still leads to this very object. */
static inline int sf_i_is_current(const sf_client *c, const char *suffix, const sf_object *o) {
  char path[96];
  struct stat status;
  if (o->memory == NULL || !sf_i_path(c->name, suffix, path) || lstat(path, &status) != 0) return 0;
  return SF_CAST(uint64_t, status.st_dev) == o->device && SF_CAST(uint64_t, status.st_ino) == o->inode;
}

/* Give up the world block of sf_sim_pose; with `remove` its name goes, too. */
static inline void sf_i_release_world(sf_client *c, int remove) {
  char path[96];
  if (c->world.memory == NULL) return;
  if (remove) {
    if (sf_i_is_current(c, ".world", &c->world) && sf_i_path(c->name, ".world", path)) unlink(path);
    if (sf_i_path(c->name, ".world.lock", path)) unlink(path);
  }
  sf_i_close(&c->world);
}

/* A part of a board, by its name; NULL when it is missing, too small or outside the object. */
static inline const unsigned char *sf_i_part(const sf_object *board, const char *name, uint64_t bytes) {
  const sf_board_header *h = SF_VIEW(const sf_board_header *, board->memory);
  for (uint32_t k = 0; k < SF_REGIONS && k < h->n_regions; k++) {
    const sf_region *r = &h->region[k];
    if (strncmp(r->name, name, sizeof r->name) != 0) continue;
    if (r->size < bytes || r->offset % 64 != 0 || r->offset > board->size || r->size > board->size - r->offset)
      return NULL;
    for (uint64_t at = r->offset; at < r->offset + bytes; at += SF_PAGE) /* take the page faults now */
      (void)*SF_CAST(const volatile unsigned char *, board->memory + at);
    return board->memory + r->offset;
  }
  return NULL;
}

static inline uint64_t sf_i_latch_bytes(uint64_t payload_bytes) {
  return SF_LATCH_HEAD_BYTES + SF_LATCH_SLOTS * sf_latch_stride(payload_bytes);
}

/* Map and check a board; the client's own is untouched until all is well. */
static inline int sf_i_open_board(sf_client *c, int64_t wait_ns) {
  sf_object board;
  const int64_t deadline = sf_now_ns() + wait_ns;
  int err;
  for (;;) {
    err = sf_i_open(c, "", &board);
    if (err == SF_OK) {
      const sf_board_header *h = SF_VIEW(const sf_board_header *, board.memory);
      const int64_t state = sf_load_acquire(&h->state); /* stored last, so that all else is there */
      if (sf_load_relaxed(&h->magic) == SF_BOARD_MAGIC && state >= SF_STATE_READY) break;
      sf_i_close(&board);
      err = SF_ERR_NOT_READY;
    }
    if (err != SF_ERR_NOT_READY || sf_now_ns() >= deadline) return err;
    sf_sleep_until_ns(sf_now_ns() + 5000000);
  }
  const sf_board_header *h = SF_VIEW(const sf_board_header *, board.memory);
  if (h->version != SF_LAYOUT_VERSION || h->layout_hash != SF_LAYOUT_HASH) {
    sf_i_close(&board);
    return SF_ERR_LAYOUT;
  }
  const unsigned char *output = sf_i_part(&board, "output", sf_i_latch_bytes(sizeof(sf_output)));
  const unsigned char *params = sf_i_part(&board, "params", sf_i_latch_bytes(sizeof(sf_params)));
  const unsigned char *acks = sf_i_part(&board, "acks", SF_CLIENTS * sf_i_latch_bytes(sizeof(sf_ack)));
  const unsigned char *map_acks = sf_i_part(&board, "map_acks", SF_CLIENTS * sf_i_latch_bytes(sizeof(sf_ack)));
  const unsigned char *ticker = sf_i_part(&board, "ticker", sf_i_latch_bytes(sizeof(sf_main_thread_state)));
  const unsigned char *map_status = sf_i_part(&board, "map_status", sf_i_latch_bytes(sizeof(sf_map_status)));
  const unsigned char *stats = sf_i_part(&board, "stats", sizeof(sf_stats));
  if (!output || !params || !acks || !map_acks || !ticker || !map_status || !stats || h->period_ns <= 0) {
    sf_i_close(&board);
    return SF_ERR_BLOCK;
  }
  sf_i_close(&c->board);
  c->board = board;
  c->owner = SF_CAST(int64_t, board.owner); /* no other user's from now on */
  c->output = output, c->params = params, c->acks = acks, c->map_acks = map_acks;
  c->ticker = ticker, c->map_status = map_status, c->stats = stats;
  c->ended = 0;
  c->next_look_ns = c->next_life_ns = 0;
  c->epoch = h->epoch;
  c->period_ns = h->period_ns;
  c->stale_ns = sf_i_stale_ns(&c->options, h->period_ns);
  if (!sf_i_is_current(c, ".map", &c->map)) {
    sf_object map; /* without it only the map's functions fail */
    sf_i_close(&c->map);
    if (sf_i_open(c, ".map", &map) == SF_OK) {
      if (map.owner == c->board.owner)
        c->map = map;
      else /* another user's, under the name of the service's */
        sf_i_close(&map);
    }
  }
  return SF_OK;
}

