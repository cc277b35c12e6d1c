
#ifndef SURFFOLLOW_BLOCKS_READER
#define SURFFOLLOW_BLOCKS_READER
/* A block mapped read-only. After a restart of its writer `given_up` asks to open it again. */
typedef struct sfb_block {
  unsigned char *memory;
  size_t size, payload_bytes;
  const unsigned char *latch;
  uid_t owner; /* the user whose block it is */
  ino_t inode;
} sfb_block;

static inline uint64_t sfb_word(const unsigned char *memory, size_t at) {
  return SF_CAST(uint64_t, sf_load_acquire(memory + at));
}

/* Map block NAME.BLOCK if it has this schema's hash and belongs to user `owner` (SF_OWNER_DEFAULT: this
 * process's own user, root, or the one that SURFFOLLOW_OWNER names): 0, or a negative errno (ENOENT no such
 * block, EACCES no permission, EPERM another user's, EPROTO another schema or no block). */
static inline int sfb_open_owner(sfb_block *block, const char *object_name, uint64_t hash,
                                 size_t payload_bytes, int64_t owner) {
  char path[80];
  struct stat status;
  void *memory;
  int fd;
  memset(block, 0, sizeof *block);
  if (object_name[0] == '.' || strchr(object_name, '/') != NULL) return -EINVAL;
  if (snprintf(path, sizeof path, "/dev/shm/%s", object_name) >= SF_CAST(int, sizeof path))
    return -ENAMETOOLONG;
  /* what stands under the name may be anything of anybody's: nothing here waits for it */
  fd = open(path, O_RDONLY | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK | O_NOCTTY);
  if (fd < 0) return -errno;
  if (fstat(fd, &status) == 0 && S_ISREG(status.st_mode) && !sf_i_owner_ok(owner, status.st_uid)) {
    close(fd);
    return -EPERM;
  }
  if (fstat(fd, &status) != 0 || !S_ISREG(status.st_mode) || status.st_size < {head_bytes}) {
    close(fd);
    return -EPROTO;
  }
  memory = mmap(NULL, SF_CAST(size_t, status.st_size), PROT_READ, MAP_SHARED, fd, 0);
  close(fd);
  if (memory == MAP_FAILED) return -errno;
  block->memory = SF_CAST(unsigned char *, memory);
  block->size = SF_CAST(size_t, status.st_size);
  block->payload_bytes = payload_bytes;
  {
    const uint64_t latch = sfb_word(block->memory, {latch_offset});
    const size_t need = SF_LATCH_HEAD_BYTES + SF_LATCH_SLOTS * sf_latch_stride({slot_head} + payload_bytes);
    if (sfb_word(block->memory, 0) != UINT64_C({magic}) ||
        sfb_word(block->memory, {version_at}) != {version} || sfb_word(block->memory, {hash_at}) != hash ||
        latch % 64 != 0 || latch > block->size ||
        need > block->size - latch) {
      munmap(memory, SF_CAST(size_t, status.st_size));
      block->memory = NULL;
      return -EPROTO;
    }
    block->latch = block->memory + latch;
  }
  block->owner = status.st_uid;
  block->inode = status.st_ino;
  return 0;
}

/* sfb_open_owner with SF_OWNER_DEFAULT. After a writer's restart open again with the `owner` found first. */
static inline int sfb_open(sfb_block *block, const char *object_name, uint64_t hash, size_t payload_bytes) {
  return sfb_open_owner(block, object_name, hash, payload_bytes, SF_OWNER_DEFAULT);
}

/* Whether the writer gave this object up: close it and open the name again. */
static inline int sfb_given_up(const sfb_block *block) {
  return sfb_word(block->memory, {state_at}) != {live};
}

/* Copy the newest whole payload; when it was published goes to t_ns (may be NULL). Never waits.
 * Returns its generation; 0: nothing published yet; -1: overtaken at every try. */
static inline int64_t sfb_latest(const sfb_block *block, void *payload, int64_t *t_ns) {
  const size_t stride = sf_latch_stride({slot_head} + block->payload_bytes);
  int i;
  for (i = 0; i < SF_LATCH_MAX_TRIES; i++) {
    const int64_t g = sf_load_acquire(block->latch);
    const unsigned char *slot;
    size_t k;
    if (g == 0) return 0;
    slot = block->latch + SF_LATCH_HEAD_BYTES + stride * SF_CAST(size_t, g & (SF_LATCH_SLOTS - 1));
    if (t_ns != NULL) *t_ns = sf_load_relaxed(slot + {t_at});
    for (k = 0; k < block->payload_bytes; k += 8) { /* a slot is padded to whole words */
      const int64_t word = sf_load_relaxed(slot + {slot_head} + k);
      const size_t left = block->payload_bytes - k;
      memcpy(SF_CAST(unsigned char *, payload) + k, &word, left < 8 ? left : 8);
    }
    __atomic_thread_fence(__ATOMIC_ACQUIRE);
    if (sf_load_relaxed(block->latch) - g <= SF_LATCH_SLOTS - 2) return g;
  }
  return -1;
}

/* Copy a Text member to `out`, which has room for field_bytes + 1, and end it with a NUL. A text that fills its
 * member has no NUL there: strlen, strcpy and printf("%s") of the member read beyond it.
 * Returns the length of the text, without the NUL. */
static inline size_t sfb_text(char *out, const char *field, size_t field_bytes) {
  const void *nul = memchr(field, 0, field_bytes);
  const size_t n = nul == NULL ? field_bytes : SF_CAST(size_t, SF_CAST(const char *, nul) - field);
  memcpy(out, field, n);
  out[n] = 0;
  return n;
}

/* Unmap the block. */
static inline void sfb_close(sfb_block *block) {
  if (block->memory != NULL) munmap(block->memory, block->size);
  block->memory = NULL;
}
#endif
