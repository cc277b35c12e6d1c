/* ---- simulation: the true pose, for the service's simulated sensor ------------------------------ */

static inline void sf_i_sign_world(sf_client *c) {
  sf_world_header *h = SF_VIEW(sf_world_header *, c->world.memory);
  h->layout_hash = SF_WORLD_LAYOUT_HASH;
  h->pid = SF_CAST(int64_t, getpid());
  h->epoch = sf_now_ns(); /* the clock, so that a block made anew never repeats an epoch */
  sf_store_release(&h->magic, SF_WORLD_MAGIC);
}

/*
 * Take the lock on the world block's name: a file that only its owner may open, locked while this process
 * lives. The descriptor, or an error.
 */
static inline int sf_i_lock_world(sf_client *c) {
  char path[96];
  struct stat status, there;
  struct flock lock;
  if (!sf_i_path(c->name, ".world.lock", path)) return SF_ERR_NAME;
  for (int k = 0; k < 20; k++) {
    const int fd = open(path, O_RDWR | O_CREAT | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK, 0600);
    if (fd < 0) return sf_i_errno(c, errno);
    memset(&lock, 0, sizeof lock);
    lock.l_type = F_WRLCK;
    lock.l_whence = SEEK_SET;
    lock.l_len = 1;
    const int known = fstat(fd, &status) == 0;
    if (!known || !S_ISREG(status.st_mode) || status.st_uid != geteuid() || (status.st_mode & 0177) != 0) {
      close(fd);
      return SF_ERR_NO_PERMISSION; /* another user's file stands there, or others may lock it */
    }
    /* 37: F_OFD_SETLK, which strict ISO C hides; such a lock belongs to this open and ends with it */
    if (fcntl(fd, 37, &lock) == 0) {
      /* its last owner may have removed it between our open and our lock */
      if (lstat(path, &there) == 0 && there.st_dev == status.st_dev && there.st_ino == status.st_ino) return fd;
      close(fd);
      continue;
    }
    close(fd);
    /* a writer that was just killed holds its lock until the kernel has taken it apart */
    sf_sleep_until_ns(sf_now_ns() + 5000000);
  }
  return SF_ERR_WORLD_HELD;
}

/* Map a world block that is there, to carry on in it. SF_ERR_NOT_RUNNING: there is none. */
static inline int sf_i_adopt_world(sf_client *c, const char *path) {
  struct stat status;
  const int fd = open(path, O_RDWR | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK);
  if (fd < 0) return sf_i_errno(c, errno);
  if (fstat(fd, &status) != 0 || !S_ISREG(status.st_mode) || status.st_uid != geteuid() ||
      status.st_size != SF_WORLD_BYTES) {
    close(fd);
    return SF_ERR_BLOCK;
  }
  void *memory = mmap(NULL, SF_WORLD_BYTES, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
  close(fd);
  if (memory == MAP_FAILED) return sf_i_errno(c, errno);
  c->world.memory = SF_CAST(unsigned char *, memory);
  c->world.size = SF_WORLD_BYTES;
  c->world.device = SF_CAST(uint64_t, status.st_dev);
  c->world.inode = SF_CAST(uint64_t, status.st_ino);
  c->world.owner = status.st_uid;
  return SF_VIEW(const sf_world_header *, memory)->layout_hash == SF_WORLD_LAYOUT_HASH ? SF_OK : SF_ERR_LAYOUT;
}

/* A new world block: it gets its name when it is whole. */
static inline int sf_i_make_world(sf_client *c, const char *path) {
  char nameless[64];
  struct stat status;
  /* 020000000: the bit of O_TMPFILE beside O_DIRECTORY, which strict ISO C hides */
  const int fd = open("/dev/shm", 020000000 | O_DIRECTORY | O_RDWR | O_CLOEXEC, 0640);
  if (fd < 0) return sf_i_errno(c, errno);
  int number = posix_fallocate(fd, 0, SF_WORLD_BYTES);
  if (number == 0 && (fchmod(fd, 0640) != 0 || fstat(fd, &status) != 0)) number = errno;
  void *memory = MAP_FAILED;
  if (number == 0) {
    memory = mmap(NULL, SF_WORLD_BYTES, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    if (memory == MAP_FAILED) number = errno;
  }
  if (number == 0) {
    c->world.memory = SF_CAST(unsigned char *, memory);
    c->world.size = SF_WORLD_BYTES;
    c->world.device = SF_CAST(uint64_t, status.st_dev);
    c->world.inode = SF_CAST(uint64_t, status.st_ino);
    c->world.owner = status.st_uid;
    sf_i_sign_world(c);
    snprintf(nameless, sizeof nameless, "/proc/self/fd/%d", fd);
    if (linkat(AT_FDCWD, nameless, AT_FDCWD, path, AT_SYMLINK_FOLLOW) != 0) number = errno;
  }
  close(fd);
  return number == 0 ? SF_OK : sf_i_errno(c, number);
}

/* Become the one writer of the service's world block: make it, or carry on in a dead writer's. */
static inline int sf_i_claim_world(sf_client *c) {
  char path[96];
  sf_i_release_world(c, 0);
  if (!sf_i_path(c->name, ".world", path)) return SF_ERR_NAME;
  const int lock = sf_i_lock_world(c);
  if (lock < 0) return lock;
  int result = sf_i_adopt_world(c, path);
  if (result == SF_OK) {
    sf_i_sign_world(c);
  } else {
    sf_i_close(&c->world);
    /* another version's, or cut short: never changed under its readers */
    if (result == SF_ERR_LAYOUT || result == SF_ERR_BLOCK) unlink(path);
    if (result == SF_ERR_LAYOUT || result == SF_ERR_BLOCK || result == SF_ERR_NOT_RUNNING)
      result = sf_i_make_world(c, path);
  }
  if (result != SF_OK) {
    sf_i_close(&c->world);
    close(lock);
    return result;
  }
  c->world.fd = lock; /* closing it gives the name back */
  return SF_OK;
}

/*
 * Give the simulated sensor the true pose of the tool, where reports are noisy or late: `pose` as in sf_ee_pos,
 * true at `t_ns`; `velocity` m/s and rad/s, world axes, NULL: at rest. The service itself never reads it.
 * Without it the simulated sensor takes its pose from the reports, whose errors then cancel. The first call makes
 * the block NAME.world; sf_detach removes it.
 * SF_OK, SF_ERR_POSE, _OBSERVER, _WORLD_HELD (a simulated robot or another client writes it), _LAYOUT, _SYSTEM, ...
 */
static inline int sf_sim_pose(sf_client *c, int64_t t_ns, const double pose[7], const double velocity[6]) {
  if (c == NULL || c->output == NULL || pose == NULL) return SF_ERR_ARGUMENT;
  if (c->options.observe) return SF_ERR_OBSERVER;
  sf_world_pose post;
  memset(&post, 0, sizeof post);
  const int err = sf_i_check_pose(pose, post.pose);
  if (err != SF_OK) return err;
  for (int k = 0; k < 6 && velocity != NULL; k++) {
    if (!sf_i_is_finite(velocity[k])) return SF_ERR_POSE;
    post.velocity[k] = velocity[k];
  }
  const int64_t now = sf_now_ns();
  if (c->world.memory == NULL || now > c->next_world_look_ns) {
    c->next_world_look_ns = now + SF_LOOK_EVERY_NS;
    if (c->world.memory == NULL || !sf_i_is_current(c, ".world", &c->world)) {
      const int claimed = sf_i_claim_world(c);
      if (claimed != SF_OK) return claimed;
    }
  }
  post.t_ns = t_ns;
  const uint64_t nan_bits = UINT64_C(0x7FF8000000000000); /* what the writer does not know */
  memcpy(&post.standoff_m, &nan_bits, sizeof nan_bits);
  memcpy(&post.ground_m, &nan_bits, sizeof nan_bits);
  sf_latch_write(c->world.memory + SF_PAGE, sizeof post, &post);
  return SF_OK;
}

