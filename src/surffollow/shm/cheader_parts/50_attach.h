/* ---- attachment ----------------------------------------------------------------------------- */

/* A mapped shared-memory object. Private to the functions here. */
typedef struct sf_object {
  unsigned char *memory;
  size_t size;
  uint64_t device, inode;
  int fd; /* -1 unless it carries a lock */
} sf_object;

/* How to attach; begin with sf_default_options(). */
typedef struct sf_options {
  const char *label;    /* how the service's status names this client; copied */
  int observe;          /* 1: read only; no slot, no write permission needed */
  int auto_reattach;    /* 1: sf_dev_vector looks for a restarted service itself (system calls, every 20 ms
                           while stale); 0: call sf_reattach where it suits */
  int64_t stale_periods; /* cycles of silence after which demands become zero ... */
  int64_t stale_min_ns;  /* ... but never sooner than this */
  int64_t ready_wait_ns; /* how long to wait for a service that is starting */
  int64_t timeout_ns;    /* how long a request waits for its answer (map requests: six times this) */
} sf_options;

/* A client; the caller's memory, filled by sf_attach. Only the first group is for reading. */
typedef struct sf_client {
  int64_t epoch;     /* of the service attached to; changes when it was restarted */
  int64_t period_ns; /* of its cycle */
  int64_t detail;    /* after an error: errno, holder's pid, refused parameter's number */
  int slot;          /* of the inbox; -1: none */
  /* private */
  char name[64];
  char label[32];
  sf_options options;
  sf_object board, inbox, map;
  const unsigned char *output, *params, *acks, *map_acks, *ticker, *map_status, *stats;
  unsigned char *slot_memory;
  int64_t stale_ns, next_attach_ns, next_look_ns, pose_timeout_ns, pose_held_ns;
  int64_t claim, counter;
  int pose_held, abandoned;
} sf_client;

/* The defaults: a client, re-attaching, stale after 20 periods but not before 5 ms, requests wait 5 s. */
static inline sf_options sf_default_options(void) {
  sf_options o;
  memset(&o, 0, sizeof o);
  o.auto_reattach = 1;
  o.stale_periods = 20;
  o.stale_min_ns = 5000000;
  o.ready_wait_ns = 2000000000;
  o.timeout_ns = 5000000000;
  return o;
}

static inline int sf_i_name_ok(const char *name) {
  size_t n = 0;
  for (; name[n] != '\0'; n++) {
    const char ch = name[n];
    const int letter = (ch >= 'a' && ch <= 'z') || (ch >= 'A' && ch <= 'Z') || (ch >= '0' && ch <= '9');
    if (!letter && (n == 0 || (ch != '.' && ch != '_' && ch != '-'))) return 0;
    if (n >= 48) return 0;
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
  if (number == ELOOP) return SF_ERR_BLOCK; /* a link: never followed */
  return SF_ERR_SYSTEM;
}

static inline void sf_i_forget(sf_object *o) {
  memset(o, 0, sizeof *o);
  o->fd = -1;
}

static inline void sf_i_close(sf_object *o) {
  if (o->memory != NULL) munmap(o->memory, o->size);
  if (o->fd >= 0) close(o->fd);
  sf_i_forget(o);
}

/* Map NAME + suffix; with `writable` the descriptor stays open, for it carries this process's locks. */
static inline int sf_i_open(sf_client *c, const char *suffix, int writable, sf_object *o) {
  char path[96];
  struct stat status;
  sf_i_forget(o);
  if (!sf_i_path(c->name, suffix, path)) return SF_ERR_NAME;
  int fd;
  do {
    fd = open(path, (writable ? O_RDWR : O_RDONLY) | O_CLOEXEC | O_NOFOLLOW);
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
  if (status.st_size < SF_PAGE) { /* created, not yet laid out */
    close(fd);
    return SF_ERR_NOT_READY;
  }
  void *memory = mmap(NULL, SF_CAST(size_t, status.st_size), writable ? PROT_READ | PROT_WRITE : PROT_READ,
                      MAP_SHARED, fd, 0);
  if (memory == MAP_FAILED) {
    const int number = errno;
    close(fd);
    return sf_i_errno(c, number);
  }
  o->memory = SF_CAST(unsigned char *, memory);
  o->size = SF_CAST(size_t, status.st_size);
  o->device = SF_CAST(uint64_t, status.st_dev);
  o->inode = SF_CAST(uint64_t, status.st_ino);
  o->fd = fd;
  if (!writable) {
    close(fd);
    o->fd = -1;
  }
  return SF_OK;
}

/* Whether the name still leads to this very object. */
static inline int sf_i_is_current(const sf_client *c, const char *suffix, const sf_object *o) {
  char path[96];
  struct stat status;
  if (o->memory == NULL || !sf_i_path(c->name, suffix, path) || lstat(path, &status) != 0) return 0;
  return SF_CAST(uint64_t, status.st_dev) == o->device && SF_CAST(uint64_t, status.st_ino) == o->inode;
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
    err = sf_i_open(c, "", 0, &board);
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
  const unsigned char *ticker = sf_i_part(&board, "ticker", sf_i_latch_bytes(sizeof(sf_ticker)));
  const unsigned char *map_status = sf_i_part(&board, "map_status", sf_i_latch_bytes(sizeof(sf_map_status)));
  const unsigned char *stats = sf_i_part(&board, "stats", sizeof(sf_stats));
  if (!output || !params || !acks || !map_acks || !ticker || !map_status || !stats || h->period_ns <= 0) {
    sf_i_close(&board);
    return SF_ERR_BLOCK;
  }
  sf_i_close(&c->board);
  c->board = board;
  c->output = output, c->params = params, c->acks = acks, c->map_acks = map_acks;
  c->ticker = ticker, c->map_status = map_status, c->stats = stats;
  c->epoch = h->epoch;
  c->period_ns = h->period_ns;
  c->stale_ns = c->options.stale_periods * h->period_ns;
  if (c->stale_ns < c->options.stale_min_ns) c->stale_ns = c->options.stale_min_ns;
  if (!sf_i_is_current(c, ".map", &c->map)) {
    sf_object map; /* without it only the map's functions fail */
    sf_i_close(&c->map);
    if (sf_i_open(c, ".map", 0, &map) == SF_OK) c->map = map;
  }
  return SF_OK;
}

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

static inline int sf_i_lock(int fd, off_t byte) {
  struct flock lock;
  memset(&lock, 0, sizeof lock);
  lock.l_type = F_WRLCK;
  lock.l_whence = SEEK_SET;
  lock.l_start = byte;
  lock.l_len = 1;
  for (;;) {
    /* 37: F_OFD_SETLK, which strict ISO C hides; such a lock belongs to this open and ends with it */
    if (fcntl(fd, 37, &lock) == 0) return 0;
    if (errno != EINTR) return errno;
  }
}

static inline void sf_i_release_slot(sf_client *c) {
  if (c->slot_memory != NULL) {
    sf_slot_head *head = SF_VIEW(sf_slot_head *, c->slot_memory + SF_SLOT_HEAD);
    sf_store_relaxed(&head->access, SF_ACCESS_FREE);
    sf_store_relaxed(&head->pid, 0);
    sf_store_release(&head->claim, 0);
  }
  c->slot = -1;
  c->slot_memory = NULL;
  c->pose_held = 0;
  sf_i_close(&c->inbox);
}

/* Take a free slot of the inbox: its lock says who owns it, and the kernel frees it when we die. */
static inline int sf_i_claim_slot(sf_client *c) {
  sf_object inbox;
  const int err = sf_i_open(c, ".inbox", 1, &inbox);
  if (err != SF_OK) return err;
  const sf_inbox_header *h = SF_VIEW(const sf_inbox_header *, inbox.memory);
  if (inbox.size < SF_INBOX_BYTES || h->magic != SF_INBOX_MAGIC || h->epoch != c->epoch) {
    sf_i_close(&inbox);
    return SF_ERR_NOT_READY; /* of a service that is being replaced */
  }
  if (h->version != SF_LAYOUT_VERSION || h->layout_hash != SF_LAYOUT_HASH) {
    sf_i_close(&inbox);
    return SF_ERR_LAYOUT;
  }
  for (int slot = 0; slot < SF_CLIENTS; slot++) {
    const off_t start = SF_PAGE + SF_CAST(off_t, slot) * SF_SLOT_BYTES;
    const int number = sf_i_lock(inbox.fd, start);
    if (number == EAGAIN || number == EACCES) continue;
    if (number != 0) {
      sf_i_close(&inbox);
      return sf_i_errno(c, number);
    }
    c->inbox = inbox;
    c->slot = slot;
    c->slot_memory = inbox.memory + start;
    c->claim = sf_i_random_claim();
    c->counter = 0;
    c->pose_held = c->abandoned = 0;
    sf_slot_head *head = SF_VIEW(sf_slot_head *, c->slot_memory + SF_SLOT_HEAD);
    sf_store_relaxed(&head->access, SF_ACCESS_FREE);
    sf_store_relaxed(&head->pid, SF_CAST(int64_t, getpid()));
    sf_store_relaxed(&head->heartbeat_ns, sf_now_ns());
    memcpy(head->name, c->label, sizeof c->label);
    sf_store_release(&head->claim, c->claim); /* last: a claim is never seen beside another's pid */
    return SF_OK;
  }
  sf_i_close(&inbox);
  return SF_ERR_SLOTS;
}

static inline void sf_i_read_pose_timeout(sf_client *c) {
  int64_t value;
  const size_t at = offsetof(sf_params, pose_timeout_ns);
  c->pose_timeout_ns = 100000000;
  if (sf_latch_read_part(c->params, sizeof(sf_params), at, 1, &value) > 0 && value > 0) c->pose_timeout_ns = value;
}

/* Give back the pose and the slot, unmap everything. Also right after a failed attach. */
static inline void sf_detach(sf_client *c) {
  if (c == NULL) return;
  sf_i_release_slot(c);
  sf_i_close(&c->board);
  sf_i_close(&c->map);
  c->output = c->params = c->acks = c->map_acks = c->ticker = c->map_status = c->stats = NULL;
}

/*
 * For a child after fork(), before it does anything else with surffollow: let go of its parent's clients.
 * The child would otherwise keep the parent's slot locked beyond the parent's death.
 */
static inline void sf_forget(sf_client *c) {
  if (c == NULL) return;
  c->slot_memory = NULL; /* the slot itself is the parent's: nothing is written to it */
  sf_detach(c);
}

/*
 * Attach to a running service. `options` NULL: the defaults. The client needs no initialisation;
 * attaching one that is attached leaks.
 * SF_OK, SF_ERR_NAME, _NOT_RUNNING, _NO_PERMISSION, _NOT_READY, _LAYOUT, _BLOCK, _SLOTS, _SYSTEM.
 */
static inline int sf_attach_with(sf_client *c, const char *name, const sf_options *options) {
  if (c == NULL) return SF_ERR_ARGUMENT;
  memset(c, 0, sizeof *c);
  c->slot = -1;
  sf_i_forget(&c->board);
  sf_i_forget(&c->inbox);
  sf_i_forget(&c->map);
  c->options = options != NULL ? *options : sf_default_options();
  if (c->options.stale_periods < 1 || c->options.stale_min_ns < 0) return SF_ERR_ARGUMENT;
  if (name == NULL || !sf_i_name_ok(name)) return SF_ERR_NAME;
  memcpy(c->name, name, strlen(name));
  const char *label = c->options.label;
  if (label == NULL)
    snprintf(c->label, sizeof c->label, "C %ld", SF_CAST(long, getpid()));
  else
    memcpy(c->label, label, strlen(label) < sizeof c->label - 1 ? strlen(label) : sizeof c->label - 1);
  c->options.label = NULL; /* the caller's memory may go */
  int err = sf_i_open_board(c, c->options.ready_wait_ns);
  if (err == SF_OK && !c->options.observe) err = sf_i_claim_slot(c);
  if (err != SF_OK) {
    sf_detach(c);
    return err;
  }
  sf_i_read_pose_timeout(c);
  return SF_OK;
}

/* Attach as a client that may send poses and requests. */
static inline int sf_attach(sf_client *c, const char *name) { return sf_attach_with(c, name, NULL); }

/* Attach read-only: no slot, no write permission. */
static inline int sf_observe(sf_client *c, const char *name) {
  sf_options o = sf_default_options();
  o.observe = 1;
  return sf_attach_with(c, name, &o);
}

/*
 * Look for a newer service of this name. SF_OK: attached to the current one; the pose must be claimed
 * anew, which the next sf_ee_pos does. Otherwise the error, and the old attachment stays.
 */
static inline int sf_reattach(sf_client *c) {
  if (c == NULL || c->board.memory == NULL) return SF_ERR_ARGUMENT;
  if (!sf_i_is_current(c, "", &c->board)) {
    const int err = sf_i_open_board(c, 0);
    if (err != SF_OK) return err;
    sf_i_release_slot(c);
  }
  if (!c->options.observe && c->slot_memory == NULL) {
    const int err = sf_i_claim_slot(c);
    if (err != SF_OK) return err;
  }
  sf_i_read_pose_timeout(c);
  return SF_OK;
}

/* sf_reattach, at most every 20 ms, if the options allow it. */
static inline int sf_i_reattach_sometimes(sf_client *c, int64_t now_ns) {
  if (!c->options.auto_reattach || now_ns < c->next_attach_ns) return SF_ERR_NOT_RUNNING;
  c->next_attach_ns = now_ns + SF_REATTACH_EVERY_NS;
  return sf_reattach(c);
}

