/* ---- latches: one writer publishes, readers copy whole, no side waits ----------------------- */

static inline int64_t sf_load_relaxed(const void *word) {
  return __atomic_load_n(SF_CAST(const int64_t *, word), __ATOMIC_RELAXED);
}

static inline int64_t sf_load_acquire(const void *word) {
  return __atomic_load_n(SF_CAST(const int64_t *, word), __ATOMIC_ACQUIRE);
}

static inline void sf_store_relaxed(void *word, int64_t value) {
  __atomic_store_n(SF_CAST(int64_t *, word), value, __ATOMIC_RELAXED);
}

static inline void sf_store_release(void *word, int64_t value) {
  __atomic_store_n(SF_CAST(int64_t *, word), value, __ATOMIC_RELEASE);
}

/* Bytes from one copy of a latch's payload to the next. */
static inline size_t sf_latch_stride(size_t payload_bytes) { return (payload_bytes + 63u) & ~SF_CAST(size_t, 63); }

/*
 * Copy `n_words` words from byte `from` of a latch's newest payload (steps R1-R4). Load-only and
 * bounded: works on read-only mappings, never waits.
 * Returns the generation; 0: nothing published yet; -1: overtaken SF_LATCH_MAX_TRIES times.
 */
static inline int64_t sf_latch_read_part(const void *latch, size_t payload_bytes, size_t from, size_t n_words,
                                         void *out) {
  const unsigned char *base = SF_CAST(const unsigned char *, latch);
  unsigned char *to = SF_CAST(unsigned char *, out);
  const size_t stride = sf_latch_stride(payload_bytes);
  for (int i = 0; i < SF_LATCH_MAX_TRIES; i++) {
    const int64_t g = sf_load_acquire(base); /* R1 */
    if (g == 0) return 0;
    const unsigned char *slot =
        base + SF_LATCH_HEAD_BYTES + stride * SF_CAST(size_t, g & (SF_LATCH_SLOTS - 1)) + from;
    for (size_t k = 0; k < n_words; k++) { /* R2 */
      const int64_t word = sf_load_relaxed(slot + 8 * k);
      memcpy(to + 8 * k, &word, 8);
    }
    __atomic_thread_fence(__ATOMIC_ACQUIRE); /* R3 */
    /* R4; unsigned: shared memory may hold anything */
    if (SF_CAST(uint64_t, sf_load_relaxed(base)) - SF_CAST(uint64_t, g) <= SF_LATCH_SLOTS - 2) return g;
  }
  return -1;
}

/* Copy a latch's whole newest payload; as sf_latch_read_part. */
static inline int64_t sf_latch_read(const void *latch, size_t payload_bytes, void *out) {
  return sf_latch_read_part(latch, payload_bytes, 0, payload_bytes / 8, out);
}

/* Publish a payload; the caller is the latch's only writer (steps W1-W3). */
static inline void sf_latch_write(void *latch, size_t payload_bytes, const void *payload) {
  unsigned char *base = SF_CAST(unsigned char *, latch);
  const unsigned char *from = SF_CAST(const unsigned char *, payload);
  const int64_t g = SF_CAST(int64_t, SF_CAST(uint64_t, sf_load_relaxed(base)) + 1u); /* may be anything, wraps */
  unsigned char *slot =
      base + SF_LATCH_HEAD_BYTES + sf_latch_stride(payload_bytes) * SF_CAST(size_t, g & (SF_LATCH_SLOTS - 1));
  __atomic_thread_fence(__ATOMIC_RELEASE); /* W1 */
  for (size_t k = 0; k < payload_bytes / 8; k++) { /* W2 */
    int64_t word;
    memcpy(&word, from + 8 * k, 8);
    sf_store_relaxed(slot + 8 * k, word);
  }
  sf_store_release(base, g); /* W3 */
}

/* ---- time ----------------------------------------------------------------------------------- */

/* Now on CLOCK_MONOTONIC [ns]. */
static inline int64_t sf_now_ns(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return SF_CAST(int64_t, t.tv_sec) * 1000000000 + SF_CAST(int64_t, t.tv_nsec);
}

/* Sleep until a time of CLOCK_MONOTONIC [ns]; signals do not shorten it. */
static inline void sf_sleep_until_ns(int64_t t_ns) {
  struct timespec t;
  t.tv_sec = SF_CAST(time_t, t_ns / 1000000000);
  t.tv_nsec = SF_CAST(long, t_ns % 1000000000);
  while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL) == EINTR) {
  }
}

