
#ifndef SURFFOLLOW_BLOCKS_WRITER
#define SURFFOLLOW_BLOCKS_WRITER
#define SFB_STALE 1
#define SFB_POLL_NS 50000

/* A schema as a writer needs it: sfb_..._schema() of each block. */
typedef struct sfb_schema {
  uint64_t hash, payload_bytes, text_bytes;
  const char *name;
  const unsigned char *text;
} sfb_schema;

/* A block of which this process is the one writer; for one thread, and not for forked children. */
typedef struct sfb_writer {
  unsigned char *memory, *latch;
  size_t size, payload_bytes;
  int fd, own; /* of the block and of its lock file */
  int barred;
  char path[96];
} sfb_writer;

static inline int sfb_i_lock(int fd, int command, int type, int64_t byte) {
  struct flock lock;
  memset(&lock, 0, sizeof lock);
  lock.l_type = SF_CAST(short, type);
  lock.l_whence = SEEK_SET;
  lock.l_start = byte;
  lock.l_len = 1;
  if (fcntl(fd, command, &lock) != 0) return -errno;
  return command == 36 && lock.l_type != F_UNLCK; /* 36, 37: F_OFD_GETLK and F_OFD_SETLK, which ISO C hides */
}

static inline int64_t sfb_i_start_ticks(void) {
  char text[1024];
  char *at;
  int field;
  ssize_t got;
  const int fd = open("/proc/self/stat", O_RDONLY | O_CLOEXEC);
  if (fd < 0) return 0;
  got = read(fd, text, sizeof text - 1);
  close(fd);
  if (got <= 0) return 0;
  text[got] = 0;
  at = strrchr(text, ')');
  for (field = 0; at != NULL && field < 20; field++) at = strchr(at + 1, ' ');
  return at == NULL ? 0 : strtoll(at + 1, NULL, 10);
}

/* Own the name, by the lock file that only this user can open: its descriptor, or a negative errno. */
static inline int sfb_i_own(const char *path) {
  char lock[104], text[64];
  struct stat mine, there;
  int fd, n, tries;
  snprintf(lock, sizeof lock, "%s.lock", path);
  for (tries = 0; tries < 100; tries++) {
    fd = open(lock, O_RDWR | O_CREAT | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK | O_NOCTTY, 0600);
    if (fd < 0) return -errno;
    if (fstat(fd, &mine) != 0 || !S_ISREG(mine.st_mode) || mine.st_uid != geteuid() ||
        (mine.st_mode & 0177) != 0 || mine.st_nlink > 1) {
      close(fd);
      return -EPERM;
    }
    if (sfb_i_lock(fd, 37, F_WRLCK, 0) != 0) {
      close(fd); /* a process that was just killed holds its locks until the kernel has taken it apart */
      if (tries >= 20) return -EBUSY;
      sf_sleep_until_ns(sf_now_ns() + 5000000);
      continue;
    }
    if (lstat(lock, &there) == 0 && there.st_ino == mine.st_ino && there.st_dev == mine.st_dev) {
      n = snprintf(text, sizeof text, "%lld %lld\n", SF_CAST(long long, getpid()),
                   SF_CAST(long long, sfb_i_start_ticks()));
      if (ftruncate(fd, 0) != 0 || pwrite(fd, text, SF_CAST(size_t, n), 0) != n) { /* only serves messages */
      }
      return fd;
    }
    close(fd); /* its last owner removed it meanwhile */
  }
  return -EBUSY;
}

static inline void sfb_i_store(sfb_writer *w, size_t at, int64_t value) {
  sf_store_release(w->memory + at, value);
}

static inline void sfb_i_sign(sfb_writer *w, int64_t epoch, int64_t lease_ns) {
  sfb_i_store(w, {lease_at}, lease_ns);
  sfb_i_store(w, {epoch_at}, epoch);
  sfb_i_store(w, {pid_at}, getpid());
  sfb_i_store(w, {ticks_at}, sfb_i_start_ticks());
}

static inline int sfb_i_map(sfb_writer *w, int fd, size_t size) {
  void *memory = mmap(NULL, size, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
  if (memory == MAP_FAILED) return -errno;
  w->memory = SF_CAST(unsigned char *, memory);
  w->size = size;
  w->fd = fd;
  return 0;
}

/* Continue a dead writer's block: 1; 0: there is none, or it was of another schema and is given up. */
static inline int sfb_i_continue(sfb_writer *w, const sfb_schema *s, mode_t mode, int64_t lease_ns) {
  struct stat status;
  uint64_t latch;
  const size_t need = SF_LATCH_HEAD_BYTES + SF_LATCH_SLOTS * sf_latch_stride({slot_head} + s->payload_bytes);
  int err;
  const int fd = open(w->path, O_RDWR | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK | O_NOCTTY);
  if (fd < 0) return errno == ENOENT ? 0 : -errno;
  if (fstat(fd, &status) != 0 || !S_ISREG(status.st_mode) || status.st_uid != geteuid() ||
      status.st_size < {head_bytes} + SF_LATCH_HEAD_BYTES) {
    close(fd);
    return -EPERM;
  }
  err = sfb_i_map(w, fd, SF_CAST(size_t, status.st_size));
  if (err != 0) {
    close(fd);
    return err;
  }
  if (sfb_word(w->memory, 0) != UINT64_C({magic}) || sfb_word(w->memory, {version_at}) != {version}) {
    munmap(w->memory, w->size);
    close(fd);
    w->memory = NULL;
    w->fd = -1;
    return -EPROTO; /* something that is no block bears the name */
  }
  latch = sfb_word(w->memory, {latch_offset});
  if (sfb_word(w->memory, {hash_at}) == s->hash && sfb_word(w->memory, {payload_at}) == s->payload_bytes &&
      latch % 64 == 0 && latch >= {head_bytes} && latch <= w->size && need <= w->size - latch &&
      fchmod(fd, mode) == 0) {
    w->latch = w->memory + latch;
    sfb_i_sign(w, SF_CAST(int64_t, sfb_word(w->memory, {epoch_at}) + 1), lease_ns);
    sfb_i_store(w, {waiting_at}, 0);
    sfb_i_store(w, {state_at}, {live});
    return 1;
  }
  sfb_i_store(w, {state_at}, {gone});
  unlink(w->path);
  munmap(w->memory, w->size);
  close(fd);
  w->memory = NULL;
  w->fd = -1;
  return 0;
}

/* Make the block; it gets its name when it is complete. */
static inline int sfb_i_make(sfb_writer *w, const sfb_schema *s, const char *object_name, mode_t mode,
                             int64_t lease_ns) {
  struct timespec now;
  char link_name[64];
  const size_t page = {head_bytes}, latch = page + (s->text_bytes + page - 1) / page * page;
  size_t size = SF_LATCH_HEAD_BYTES + SF_LATCH_SLOTS * sf_latch_stride({slot_head} + s->payload_bytes);
  int err;
  /* 020000000: the bit that makes O_TMPFILE of O_DIRECTORY, which ISO C hides */
  const int fd = open("/dev/shm", 020000000 | O_DIRECTORY | O_RDWR | O_CLOEXEC, 0600);
  if (fd < 0) return -errno;
  size = latch + (size + page - 1) / page * page;
  err = ftruncate(fd, SF_CAST(off_t, size)) != 0 ? errno : posix_fallocate(fd, 0, SF_CAST(off_t, size));
  if (err == 0 && fchmod(fd, mode) != 0) err = errno;
  if (err == 0) err = -sfb_i_map(w, fd, size);
  if (err != 0) {
    close(fd);
    return -err;
  }
  w->latch = w->memory + latch;
  sfb_i_store(w, {version_at}, {version});
  sfb_i_store(w, {hash_at}, SF_CAST(int64_t, s->hash));
  sfb_i_store(w, {payload_at}, SF_CAST(int64_t, s->payload_bytes));
  sfb_i_store(w, {text_at}, SF_CAST(int64_t, s->text_bytes));
  sfb_i_store(w, {latch_offset}, SF_CAST(int64_t, latch));
  sfb_i_store(w, {size_at}, SF_CAST(int64_t, size));
  memcpy(w->memory + {name_at}, object_name, strlen(object_name));
  memcpy(w->memory + {schema_name_at}, s->name, strlen(s->name) < 63 ? strlen(s->name) : 63);
  memcpy(w->memory + page, s->text, s->text_bytes);
  clock_gettime(CLOCK_REALTIME, &now); /* a block made anew, or after a reboot, never repeats an epoch */
  sfb_i_sign(w, SF_CAST(int64_t, now.tv_sec) * 1000000000 + now.tv_nsec, lease_ns);
  sfb_i_store(w, {state_at}, {live});
  sfb_i_store(w, 0, SF_CAST(int64_t, UINT64_C({magic})));
  snprintf(link_name, sizeof link_name, "/proc/self/fd/%d", fd);
  if (linkat(AT_FDCWD, link_name, AT_FDCWD, w->path, AT_SYMLINK_FOLLOW) != 0) return -errno;
  return 0;
}

/* End in peace: the block's name goes, unless `keep`: the next writer continues it. */
static inline void sfb_end_writing(sfb_writer *w, int keep) {
  char lock[104];
  if (w->memory != NULL && !keep) {
    sfb_i_store(w, {state_at}, {gone});
    unlink(w->path);
  } else if (w->memory != NULL) {
    sfb_i_store(w, {ticks_at}, 0);
  }
  if (w->memory != NULL) munmap(w->memory, w->size);
  if (w->fd >= 0) close(w->fd);
  if (w->own >= 0) {
    snprintf(lock, sizeof lock, "%s.lock", w->path);
    unlink(lock);
    close(w->own);
  }
  memset(w, 0, sizeof *w);
  w->fd = w->own = -1;
}

/*
 * Become the one writer of block NAME.BLOCK: make it, or continue a dead writer's. `mode`: who may read it
 * (0640); `lease_ms`: how long a reader may hold a write up (500).
 * Returns 0, or a negative errno: -EBUSY another live process writes it, -EPERM it is another user's.
 */
static inline int sfb_start_writing(sfb_writer *w, const char *object_name, const sfb_schema *schema,
                                    mode_t mode, int lease_ms) {
  const int64_t lease_ns = SF_CAST(int64_t, lease_ms) * 1000000;
  int err;
  memset(w, 0, sizeof *w);
  w->fd = w->own = -1;
  if (object_name[0] == '.' || strchr(object_name, '/') != NULL || strlen(object_name) > 60) return -EINVAL;
  snprintf(w->path, sizeof w->path, "/dev/shm/%s", object_name);
  w->payload_bytes = schema->payload_bytes;
  w->own = sfb_i_own(w->path);
  if (w->own < 0) {
    err = w->own;
    w->own = -1;
    return err;
  }
  err = sfb_i_continue(w, schema, mode, lease_ns);
  if (err == 0) {
    err = sfb_i_make(w, schema, object_name, mode, lease_ns);
    if (err == 0) return 0;
  } else if (err == 1) {
    return 0;
  }
  if (w->memory != NULL) munmap(w->memory, w->size);
  w->memory = NULL;
  sfb_end_writing(w, 1);
  return err;
}

