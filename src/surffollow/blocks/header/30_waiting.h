/* Steps A2, A3 and A5: the fence number to write under; `timeout_ms` below the lease may end it sooner. */
static inline int64_t sfb_i_wait_for_readers(sfb_writer *w, int timeout_ms) {
  const int64_t lease = SF_CAST(int64_t, sfb_word(w->memory, {lease_at}));
  int64_t number = SF_CAST(int64_t, sfb_word(w->memory, {fence_at}));
  int64_t since = sf_now_ns(), seen = since, deadline = since + SF_CAST(int64_t, timeout_ms) * 1000000;
  if (sfb_i_lock(w->fd, 37, F_WRLCK, {fence_base} + number) == 0) {
    w->barred = 0;
    return number;
  }
  sfb_i_store(w, {waiting_at}, since);
  while (!w->barred) {
    int64_t now;
    if (sfb_i_lock(w->fd, 37, F_WRLCK, {fence_base} + number) == 0) return number;
    now = sf_now_ns();
    if (now - seen > lease) { /* we were stopped, not they */
      since = now;
      sfb_i_store(w, {waiting_at}, since);
    } else if (now - since >= lease) {
      sfb_i_store(w, {fence_at}, ++number);
      if (sfb_i_lock(w->fd, 37, F_WRLCK, {fence_base} + number) == 0) return number;
      w->barred = 1;
      break;
    }
    seen = now;
    if (now >= deadline) {
      sfb_i_store(w, {waiting_at}, 0);
      return -ETIMEDOUT;
    }
    sf_sleep_until_ns(now + SFB_POLL_NS);
  }
  sfb_i_store(w, {fence_at}, ++number); /* behind the closed door, with no lock (A5) */
  return number;
}

/*
 * Publish a whole structure when all reading has finished, or its lease is over.
 * Returns the generation (from 1), or -ETIMEDOUT: readers did not finish in time, nothing was published.
 */
static inline int64_t sfb_write(sfb_writer *w, const void *payload, int timeout_ms) {
  const size_t stride = sf_latch_stride({slot_head} + w->payload_bytes);
  const int64_t fence = sfb_i_wait_for_readers(w, timeout_ms), g = sf_load_relaxed(w->latch) + 1;
  unsigned char *slot = w->latch + SF_LATCH_HEAD_BYTES + stride * SF_CAST(size_t, g & (SF_LATCH_SLOTS - 1));
  size_t k;
  if (fence < 0) return fence;
  __atomic_thread_fence(__ATOMIC_RELEASE); /* W1 */
  sf_store_relaxed(slot, g);
  sf_store_relaxed(slot + 8, SF_CAST(int64_t, sfb_word(w->memory, {epoch_at})));
  sf_store_relaxed(slot + {t_at}, sf_now_ns());
  for (k = 0; k < w->payload_bytes; k += 8) { /* W2; a slot is padded to whole words */
    const size_t left = w->payload_bytes - k;
    int64_t word = 0;
    memcpy(&word, SF_CAST(const unsigned char *, payload) + k, left < 8 ? left : 8);
    sf_store_relaxed(slot + {slot_head} + k, word);
  }
  sf_store_release(w->latch, g); /* W3 */
  sfb_i_lock(w->fd, 37, F_UNLCK, {fence_base} + fence);
  sfb_i_store(w, {waiting_at}, 0);
  return g;
}

/* A read that keeps the writer out: from sfb_read_begin to sfb_read_done, at most the writer's lease. */
typedef struct sfb_reading {
  int fd;
  int64_t fence, generation;
  const unsigned char *payload;
} sfb_reading;

/*
 * Wait until writing has finished, and keep the writer out; `reading->payload` is the structure itself.
 * Returns its generation; -ETIMEDOUT: no turn, or nothing published yet, in time; -ESTALE: the writer gave
 * the block up, close it and open the name again.
 */
static inline int64_t sfb_read_begin(const sfb_block *block, const char *object_name, sfb_reading *reading,
                                     int timeout_ms) {
  char path[96];
  struct stat status;
  const int64_t deadline = sf_now_ns() + SF_CAST(int64_t, timeout_ms) * 1000000;
  const size_t stride = sf_latch_stride({slot_head} + block->payload_bytes);
  int queued = 0;
  snprintf(path, sizeof path, "/dev/shm/%.60s", object_name);
  if (sfb_given_up(block)) return -ESTALE;
  reading->fd = open(path, O_RDONLY | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK | O_NOCTTY);
  if (reading->fd < 0) return errno == ENOENT ? -ESTALE : -errno;
  if (fstat(reading->fd, &status) != 0 || status.st_ino != block->inode) {
    close(reading->fd);
    return -ESTALE;
  }
  for (;;) {
    const int64_t number = SF_CAST(int64_t, sfb_word(block->memory, {fence_at})), now = sf_now_ns();
    const int64_t waiting = SF_CAST(int64_t, sfb_word(block->memory, {waiting_at}));
    const int64_t lease = SF_CAST(int64_t, sfb_word(block->memory, {lease_at}));
    if ((waiting == 0 || now - waiting > 2 * lease) && sf_load_acquire(block->latch) != 0 && /* A1 */
        sfb_i_lock(reading->fd, 37, F_RDLCK, {fence_base} + number) == 0) {
      if (SF_CAST(int64_t, sfb_word(block->memory, {fence_at})) == number) {
        reading->fence = number;
        reading->generation = sf_load_acquire(block->latch);
        reading->payload = block->latch + SF_LATCH_HEAD_BYTES + {slot_head} +
                           stride * SF_CAST(size_t, reading->generation & (SF_LATCH_SLOTS - 1));
        if (queued) sfb_i_lock(reading->fd, 37, F_UNLCK, {queue_byte});
        return reading->generation;
      }
      sfb_i_lock(reading->fd, 37, F_UNLCK, {fence_base} + number);
    }
    if (!queued) queued = sfb_i_lock(reading->fd, 37, F_RDLCK, {queue_byte}) == 0;
    if (now >= deadline || sfb_given_up(block)) {
      close(reading->fd);
      return sfb_given_up(block) ? -ESTALE : -ETIMEDOUT;
    }
    sf_sleep_until_ns(now + SFB_POLL_NS);
  }
}

/* Let the writer in: 0, or SFB_STALE: the lease ran out meanwhile, what was read may be a mixture. */
static inline int sfb_read_done(const sfb_block *block, sfb_reading *reading) {
  const int stale = SF_CAST(int64_t, sfb_word(block->memory, {fence_at})) != reading->fence; /* A4 */
  close(reading->fd); /* and with it the lock: this open has no mapping */
  reading->fd = -1;
  return stale ? SFB_STALE : 0;
}
#endif
