/* ---- a slot of the service, through its socket (docs/reference/protocol.md, "Getting a slot") ----------- */

/* Numbers that strict ISO C hides; the same on x86-64 and aarch64. */
#define SF_I_SO_PEERCRED 17
#define SF_I_SO_PASSRIGHTS 83 /* Linux 6.16 */
#define SF_I_GET_SEALS 1034
#define SF_I_SIZE_SEALS 6 /* F_SEAL_SHRINK, F_SEAL_GROW */

/* Wait until a socket can be read. 0, or an errno: ETIMEDOUT. */
static inline int sf_i_await(int fd, int64_t deadline_ns) {
  for (;;) {
    struct pollfd request;
    const int64_t left_ns = deadline_ns - sf_now_ns();
    request.fd = fd;
    request.events = POLLIN;
    request.revents = 0;
    const int got = poll(&request, 1, left_ns > 0 ? SF_CAST(int, left_ns / 1000000) + 1 : 0);
    if (got > 0) return 0;
    if (got == 0 && sf_now_ns() >= deadline_ns) return ETIMEDOUT;
    if (got < 0 && errno != EINTR) return errno;
  }
}

/* End the exchange that is under way, if any. */
static inline void sf_i_stop_asking(sf_client *c) {
  if (c->asking.memory != NULL) munmap(c->asking.memory, SF_SLOT_BYTES);
  if (c->asking.deadline_ns != 0 && c->asking.fd >= 0) close(c->asking.fd); /* 0: never begun */
  memset(&c->asking, 0, sizeof c->asking);
  c->asking.fd = -1;
}

/* A socket for a new exchange. SF_OK or an error. */
static inline int sf_i_begin_asking(sf_client *c) {
  const int none = 0;
  const int fd = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
  if (fd < 0) return sf_i_errno(c, errno);
  /* until it is known who listens; kernels before 6.16 cannot */
  (void)setsockopt(fd, SOL_SOCKET, SF_I_SO_PASSRIGHTS, &none, SF_CAST(socklen_t, sizeof none));
  c->asking.fd = fd;
  c->asking.stage = 0;
  c->asking.deadline_ns = sf_now_ns() + SF_EXCHANGE_NS;
  return SF_OK;
}

/* Connect to NAME.sock and see who listens. SF_OK, SF_PENDING (many clients come at once), or an error. */
static inline int sf_i_connect(sf_client *c) {
  char path[96];
  struct sockaddr_un address;
  const int fd = c->asking.fd, enabled = 1;
  if (!sf_i_path(c->name, ".sock", path)) return SF_ERR_NAME;
  memset(&address, 0, sizeof address);
  address.sun_family = AF_UNIX;
  memcpy(address.sun_path, path, strlen(path) + 1); /* 96 of 108 bytes */
  if (connect(fd, SF_VIEW(const struct sockaddr *, &address), SF_CAST(socklen_t, sizeof address)) != 0) {
    const int number = errno;
    if (number == EINTR || number == EAGAIN) return SF_PENDING;
    if (number == ENOENT || number == ECONNREFUSED) {
      c->ended = 1; /* known before its demand is old */
      return SF_ERR_NOT_READY;
    }
    if (number == EPROTOTYPE || number == ENOTSOCK) return SF_ERR_BLOCK;
    return sf_i_errno(c, number);
  }
  int32_t peer[3] = {0, -1, -1}; /* pid, uid, gid of the process that listens, from the kernel */
  socklen_t size = sizeof peer;
  if (getsockopt(fd, SOL_SOCKET, SF_I_SO_PEERCRED, peer, &size) != 0 ||
      SF_CAST(uid_t, peer[1]) != c->board.owner) {
    c->detail = peer[1];
    return SF_ERR_OWNER;
  }
  (void)setsockopt(fd, SOL_SOCKET, SF_I_SO_PASSRIGHTS, &enabled, SF_CAST(socklen_t, sizeof enabled));
  return SF_OK;
}

/* Send one message of the exchange. 0, or an errno; never a signal. */
static inline int sf_i_say(const sf_client *c, int fd, int64_t step, int64_t slot, int64_t claim) {
  sf_slot_message m;
  memset(&m, 0, sizeof m);
  m.magic = SF_SLOT_MAGIC;
  m.layout_hash = SF_LAYOUT_HASH;
  m.step = step;
  m.epoch = c->epoch;
  m.slot = slot;
  m.claim = claim;
  memcpy(m.name, c->label, sizeof m.name);
  for (;;) {
    const ssize_t sent = send(fd, &m, sizeof m, MSG_NOSIGNAL | MSG_DONTWAIT);
    if (sent == SF_CAST(ssize_t, sizeof m)) return 0;
    if (sent >= 0) return EMSGSIZE;
    if (errno != EINTR) return errno;
  }
}

/* Receive one message and, with it, at most one descriptor (else -1). SF_OK, SF_PENDING: none yet, or an error. */
static inline int sf_i_hear(sf_client *c, int fd, sf_slot_message *m, int *memory_fd) {
  /* the control data of one descriptor, aligned as its head requires */
  union {
    struct cmsghdr head;
    unsigned char bytes[CMSG_SPACE(sizeof(int))];
  } control;
  struct iovec piece;
  struct msghdr message;
  *memory_fd = -1;
  memset(&control, 0, sizeof control);
  memset(&message, 0, sizeof message);
  piece.iov_base = m;
  piece.iov_len = sizeof *m;
  message.msg_iov = &piece;
  message.msg_iovlen = 1;
  message.msg_control = &control;
  message.msg_controllen = sizeof control;
  ssize_t got;
  do {
    got = recvmsg(fd, &message, MSG_CMSG_CLOEXEC | MSG_DONTWAIT);
  } while (got < 0 && errno == EINTR);
  if (got < 0 && (errno == EAGAIN || errno == EWOULDBLOCK)) return SF_PENDING;
  if (got <= 0) return SF_ERR_NOT_READY; /* it closed the connection: it is being replaced */
  const struct cmsghdr *head = CMSG_FIRSTHDR(&message);
  if (head != NULL && head->cmsg_level == SOL_SOCKET && head->cmsg_type == SCM_RIGHTS &&
      head->cmsg_len == CMSG_LEN(sizeof(int)))
    memcpy(memory_fd, CMSG_DATA(head), sizeof(int));
  if (message.msg_flags & MSG_CTRUNC) {
    c->detail = EMFILE;
    return SF_ERR_SYSTEM;
  }
  if (got != SF_CAST(ssize_t, sizeof *m) || (message.msg_flags & MSG_TRUNC) || m->magic != SF_SLOT_MAGIC)
    return SF_ERR_BLOCK;
  if (m->step == SF_SLOT_REFUSE) {
    c->detail = m->detail;
    if (m->result == SF_SLOT_OTHER_RUN) return SF_ERR_NOT_READY;
    if (m->result == SF_SLOT_ALL_TAKEN || m->result == SF_SLOT_USER_LIMIT || m->result == SF_SLOT_PROCESS_LIMIT)
      return SF_ERR_SLOTS;
    return SF_ERR_LAYOUT;
  }
  return m->layout_hash == SF_LAYOUT_HASH ? SF_OK : SF_ERR_LAYOUT;
}

/* Map what the service handed out; its size is sealed, so that no access to it can ever be a signal. */
static inline int sf_i_map_slot(sf_client *c, int fd, unsigned char **slot) {
  struct stat status;
  const int seals = fd >= 0 ? fcntl(fd, SF_I_GET_SEALS) : -1;
  if (seals < 0 || (seals & SF_I_SIZE_SEALS) != SF_I_SIZE_SEALS || fstat(fd, &status) != 0 ||
      status.st_size != SF_SLOT_BYTES)
    return SF_ERR_BLOCK;
  void *memory = mmap(NULL, SF_SLOT_BYTES, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
  if (memory == MAP_FAILED) return sf_i_errno(c, errno);
  *slot = SF_CAST(unsigned char *, memory);
  return SF_OK;
}

/* The offer: map its memory and say so. SF_OK, SF_PENDING or an error. */
static inline int sf_i_take_offer(sf_client *c) {
  sf_slot_message offer;
  int memory_fd = -1;
  memset(&offer, 0, sizeof offer);
  int err = sf_i_hear(c, c->asking.fd, &offer, &memory_fd);
  if (err == SF_OK &&
      (offer.step != SF_SLOT_OFFER || offer.slot < 0 || offer.slot >= SF_CLIENTS || offer.claim == 0))
    err = SF_ERR_BLOCK;
  if (err == SF_OK) err = sf_i_map_slot(c, memory_fd, &c->asking.memory);
  if (memory_fd >= 0) close(memory_fd);
  if (err != SF_OK) return err;
  c->asking.slot = SF_CAST(int, offer.slot);
  c->asking.claim = offer.claim;
  return sf_i_say(c, c->asking.fd, SF_SLOT_MAPPED, offer.slot, offer.claim) == 0 ? SF_OK : SF_ERR_NOT_READY;
}

/* Go as far as it goes without waiting. SF_OK: the grant is there; SF_PENDING; or an error. */
static inline int sf_i_go_on_asking(sf_client *c) {
  int err = SF_OK, none = -1;
  sf_slot_message grant;
  if (c->asking.fd < 0) err = sf_i_begin_asking(c);
  if (err == SF_OK && c->asking.stage == 0) {
    err = sf_i_connect(c);
    if (err == SF_OK && sf_i_say(c, c->asking.fd, SF_SLOT_ASK, 0, 0) != 0) err = SF_ERR_NOT_READY;
    if (err == SF_OK) c->asking.stage = 1;
  }
  if (err == SF_OK && c->asking.stage == 1) {
    err = sf_i_take_offer(c);
    if (err == SF_OK) c->asking.stage = 2;
  }
  if (err != SF_OK) return err;
  err = sf_i_hear(c, c->asking.fd, &grant, &none);
  if (none >= 0) close(none);
  return err == SF_OK && grant.step != SF_SLOT_GRANT ? SF_ERR_BLOCK : err;
}

/*
 * One step towards a slot: the connection says who owns it, and the kernel closes that when we die. Never waits.
 * SF_OK, SF_PENDING: call it again, SF_ERR_NOT_READY (the service is being replaced or stands still),
 * SF_ERR_SLOTS (`detail`: the limit), SF_ERR_OWNER, _NO_PERMISSION, _BLOCK, ...
 */
static inline int sf_i_step_to_slot(sf_client *c) {
  const int err = sf_i_go_on_asking(c);
  if (err == SF_PENDING && sf_now_ns() < c->asking.deadline_ns) return SF_PENDING;
  if (err != SF_OK) {
    sf_i_stop_asking(c);
    return err == SF_PENDING ? SF_ERR_NOT_READY : err;
  }
  c->held.memory = c->slot_memory = c->asking.memory;
  c->held.size = SF_SLOT_BYTES;
  c->held.fd = c->asking.fd;
  c->slot = c->asking.slot;
  c->claim = c->asking.claim;
  c->asking.memory = NULL; /* they are the slot's from here on */
  c->asking.fd = -1;
  c->counter = 0;
  c->ended = 0;
  c->pose_held = c->abandoned = c->ranges_held = 0;
  c->claiming.counter = 0;
  c->grant = 0;
  return SF_OK;
}

/* Wait for a slot; as a rule well below a millisecond. Not for a control loop. */
static inline int sf_i_claim_slot(sf_client *c, int64_t deadline_ns) {
  for (;;) {
    const int err = sf_i_step_to_slot(c);
    if (err != SF_PENDING) return err;
    const int64_t now = sf_now_ns();
    if (now >= deadline_ns) {
      sf_i_stop_asking(c);
      return SF_ERR_NOT_READY;
    }
    if (c->asking.stage == 0)
      sf_sleep_until_ns(now + 2000000);
    else
      (void)sf_i_await(c->asking.fd, deadline_ns);
  }
}

/* Whether the service holds its end of the connection: it closes it when it ends or takes the slot back. */
static inline int sf_i_slot_is_open(const sf_client *c) {
  char byte;
  for (;;) {
    const ssize_t got = recv(c->held.fd, &byte, 1, MSG_PEEK | MSG_DONTWAIT);
    if (got > 0) return 1;
    if (got == 0) return 0;
    if (errno != EINTR) return errno == EAGAIN || errno == EWOULDBLOCK;
  }
}

/* Give the slot back: nothing is written to it, the closed connection says it all. */
static inline void sf_i_release_slot(sf_client *c) {
  c->slot = -1;
  c->slot_memory = NULL;
  c->pose_held = c->ranges_held = 0;
  sf_i_close(&c->held);
  sf_i_stop_asking(c);
}

/*
 * Whether there is a slot; when not (after a restart of the service, or when it took the last one back), one step
 * towards one. Never waits; SF_ERR_NOT_READY: call it again.
 */
static inline int sf_i_ensure_slot(sf_client *c) {
  if (c->slot_memory != NULL) return SF_OK;
  if (!c->options.auto_reattach) return SF_ERR_NOT_RUNNING;
  const int err = sf_i_step_to_slot(c);
  return err == SF_PENDING ? SF_ERR_NOT_READY : err;
}

