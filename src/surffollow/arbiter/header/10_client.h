/* ---- a client of an arbiter ----------------------------------------------------------------- */

/*
 * One attachment; for one thread. Every call of sfa_command, sfa_request, sfa_relinquish and sfa_heartbeat
 * renews the lease: call one of them at least every 100 ms (the lease is `lease_ns` of the board).
 * `owner` is the server's user; after -EPERM from sfa_attach the one who is not trusted.
 */
typedef struct sfa_client {
  unsigned char *mailbox;
  unsigned char *board; /* mapped without write permission */
  size_t board_bytes;
  int sock;
  int64_t slot, number, epoch, head, lease_ns;
  size_t status_at, grants_at, reply_at, entry_at;
  int64_t *ours; /* 1; 0 in a forked child, which the kernel gives a zero page: what is held is the parent's */
  int64_t owner;
  char name[48], client[48];
} sfa_client;

/* One English sentence for a negative result; never NULL. */
static inline const char *sfa_strerror(int result) {
  if (result <= SFA_REFUSED) return sfa_hello_text(SFA_REFUSED - result);
  switch (-result) {
    case ENOENT: return "no arbiter of that name runs here, or it ended; start it: surffollow arbiter start";
    case EPERM:
      return "the arbiter belongs to a user who is not trusted (in the client's owner); name him: sfa_attach_owner, "
             "SURFFOLLOW_OWNER";
    case EPROTO: return "the arbiter is of another release than this header; rebuild or restart";
    case ETIMEDOUT: return "the arbiter did not answer in time";
    case EINVAL: return "an argument is missing or outside its range";
    case EAGAIN: return "the mailbox is full; the arbiter takes nothing";
    default: return strerror(-result);
  }
}

static inline long sfa_i_futex(const void *word, int wake, int64_t value, int64_t timeout_ns) {
  struct timespec limit;
  limit.tv_sec = SF_CAST(time_t, timeout_ns / 1000000000);
  limit.tv_nsec = SF_CAST(long, timeout_ns % 1000000000);
  if (wake) return syscall(SFA_SYS_FUTEX, word, 1, 0x7FFFFFFF, NULL, NULL, 0);
  return syscall(SFA_SYS_FUTEX, word, 0, SF_CAST(uint32_t, value & 0xFFFFFFFF), &limit, NULL, 0);
}

static inline int sfa_i_descriptors(struct msghdr *message, int fds[2]) {
  struct cmsghdr *c = CMSG_FIRSTHDR(message);
  if (c == NULL || c->cmsg_level != SOL_SOCKET || c->cmsg_type != SCM_RIGHTS) return 0;
  if (c->cmsg_len == CMSG_LEN(2 * sizeof(int))) {
    memcpy(fds, CMSG_DATA(c), 2 * sizeof(int));
    return 2;
  }
  return 0;
}

/* Say hello on a connected socket, take what the server gives: 0 or a negative result. */
static inline int sfa_i_greet(sfa_client *a, const char *client, int fds[2]) {
  sfa_hello hello;
  sfa_welcome answer;
  struct iovec part;
  struct msghdr message;
  union {
    char bytes[CMSG_SPACE(2 * sizeof(int))];
    struct cmsghdr align;
  } control;
  ssize_t got;
  int n;
  memset(&hello, 0, sizeof hello);
  memset(&answer, 0, sizeof answer);
  memset(&message, 0, sizeof message);
  memset(&control, 0, sizeof control);
  hello.magic = SFA_HELLO_MAGIC;
  hello.layout_hash = SFA_LAYOUT_HASH;
  memcpy(hello.name, client, strnlen(client, sizeof hello.name - 1));
  (void)!send(a->sock, &hello, sizeof hello, MSG_NOSIGNAL); /* it may have refused already: its answer decides */
  part.iov_base = &answer;
  part.iov_len = sizeof answer;
  message.msg_iov = &part;
  message.msg_iovlen = 1;
  message.msg_control = control.bytes;
  message.msg_controllen = sizeof control.bytes;
  n = 1;
  do { /* a reset is reported once; what the server sent before it closed comes next */
    got = recvmsg(a->sock, &message, MSG_CMSG_CLOEXEC);
  } while (got < 0 && (errno == EINTR || (errno == ECONNRESET && n-- > 0)));
  n = sfa_i_descriptors(&message, fds);
  if (got < 0) return errno == EAGAIN || errno == EWOULDBLOCK ? -ETIMEDOUT : -ENOENT;
  if (got != SF_CAST(ssize_t, sizeof answer) || answer.magic != SFA_HELLO_MAGIC) return got == 0 ? -ENOENT : -EPROTO;
  if (answer.result != SFA_HELLO_OK) return SFA_REFUSED - SF_CAST(int, answer.result);
  if (n != 2 || answer.slot < 0 || answer.slot >= SFA_CLIENTS) return -EPROTO;
  a->slot = answer.slot;
  a->number = answer.number;
  a->epoch = answer.epoch;
  return 0;
}

/* strict ISO C hides them */
#define SFA_I_ANONYMOUS 0x20
#define SFA_I_WIPE_ON_FORK 18

/* Map mailbox and board, and find our places in them. */
static inline int sfa_i_map(sfa_client *a, const int fds[2]) {
  struct stat status;
  const sfa_board_header *h;
  size_t slot = SF_CAST(size_t, a->slot);
  int seals;
  void *memory = mmap(NULL, SFA_MAILBOX_BYTES, PROT_READ | PROT_WRITE, MAP_SHARED, fds[0], 0);
  if (memory == MAP_FAILED) return -errno;
  seals = fcntl(fds[0], SF_I_GET_SEALS);
  if (seals < 0 || (seals & SF_I_SIZE_SEALS) != SF_I_SIZE_SEALS) {
    munmap(memory, SFA_MAILBOX_BYTES);
    return -EPROTO;
  }
  a->mailbox = SF_CAST(unsigned char *, memory);
  if (fstat(fds[1], &status) != 0 || status.st_size < SF_PAGE) return -EPROTO;
  a->board_bytes = SF_CAST(size_t, status.st_size);
  memory = mmap(NULL, a->board_bytes, PROT_READ, MAP_SHARED, fds[1], 0);
  if (memory == MAP_FAILED) return -errno;
  a->board = SF_CAST(unsigned char *, memory);
  h = SF_VIEW(const sfa_board_header *, a->board);
  if (h->magic != SFA_BOARD_MAGIC || h->layout_hash != SFA_LAYOUT_HASH || h->size > a->board_bytes) return -EPROTO;
  a->lease_ns = h->lease_ns;
  memory = mmap(NULL, SF_PAGE, PROT_READ | PROT_WRITE, MAP_PRIVATE | SFA_I_ANONYMOUS, -1, 0);
  if (memory == MAP_FAILED) return -errno;
  a->ours = SF_CAST(int64_t *, memory);
  (void)syscall(SYS_madvise, memory, SF_CAST(size_t, SF_PAGE), SFA_I_WIPE_ON_FORK); /* Linux 4.14 */
  *a->ours = 1;
  a->status_at = SFA_STATUS_AT;
  a->grants_at = SFA_GRANTS_AT + slot * SFA_GRANTS_BYTES;
  a->reply_at = SFA_REPLIES_AT + slot * SFA_REPLY_BYTES;
  a->entry_at = SFA_CLIENTS_AT + slot * SFA_ENTRY_BYTES;
  a->head = sf_load_relaxed(a->mailbox + offsetof(sfa_mailbox, head));
  return 0;
}

/* Report to the server that the mailbox is mapped, and wait until it looks into it. */
static inline int sfa_i_enter(sfa_client *a) {
  char received[8];
  ssize_t got;
  if (send(a->sock, SFA_MAPPED, sizeof SFA_MAPPED - 1, MSG_NOSIGNAL) < 0) return -ENOENT;
  do {
    got = recv(a->sock, received, sizeof received, 0);
  } while (got < 0 && errno == EINTR);
  if (got < 0) return errno == EAGAIN || errno == EWOULDBLOCK ? -ETIMEDOUT : -ENOENT;
  return got == SF_CAST(ssize_t, sizeof SFA_MAPPED - 1) ? 0 : -ENOENT;
}

/* End: everything that this client holds or waits for is given up. Its names and the server's user stay for sfa_reattach. */
static inline void sfa_detach(sfa_client *a) {
  if (a->sock >= 0 && a->name[0] != '\0') close(a->sock); /* no name: all zero, it was never attached */
  if (a->mailbox != NULL) munmap(a->mailbox, SFA_MAILBOX_BYTES);
  if (a->board != NULL) munmap(a->board, a->board_bytes);
  if (a->ours != NULL) munmap(a->ours, SF_PAGE);
  memset(a, 0, offsetof(sfa_client, owner));
  a->sock = -1;
}

#define SFA_I_SO_PASSRIGHTS 83

/* Connect to the arbiter's socket; only its user, root or the given `owner` is spoken to: 0 or a negative result. */
static inline int sfa_i_connect(sfa_client *a, int timeout_ms, int64_t owner) {
  struct sockaddr_un address;
  struct timeval limit;
  int32_t peer[3] = {0, -1, -1}; /* pid, uid, gid of the process that listens, from the kernel */
  socklen_t size = sizeof peer;
  const int no = 0, yes = 1;
  int n;
  memset(&address, 0, sizeof address);
  address.sun_family = AF_UNIX;
  n = snprintf(address.sun_path + 1, sizeof address.sun_path - 1, "surffollow.%s.arbiter", a->name);
  if (n < 0 || SF_CAST(size_t, n) >= sizeof address.sun_path - 1) return -EINVAL;
  a->sock = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0);
  if (a->sock < 0) return -errno;
  if (timeout_ms < 1) timeout_ms = 1; /* zero would mean for ever */
  limit.tv_sec = timeout_ms / 1000;
  limit.tv_usec = (timeout_ms % 1000) * 1000;
  setsockopt(a->sock, SOL_SOCKET, SO_RCVTIMEO, &limit, sizeof limit);
  setsockopt(a->sock, SOL_SOCKET, SO_SNDTIMEO, &limit, sizeof limit); /* of connect, too */
  /* no descriptors until it is known who listens: to drop one may take as long as its sender likes. Linux 6.16 */
  setsockopt(a->sock, SOL_SOCKET, SFA_I_SO_PASSRIGHTS, &no, sizeof no);
  if (connect(a->sock, SF_VIEW(const struct sockaddr *, &address),
              SF_CAST(socklen_t, offsetof(struct sockaddr_un, sun_path) + 1 + SF_CAST(size_t, n))) != 0) {
    if (errno == EAGAIN || errno == EINPROGRESS) return -ETIMEDOUT;
    return errno == ECONNREFUSED ? -ENOENT : -errno;
  }
  if (getsockopt(a->sock, SOL_SOCKET, SF_I_SO_PEERCRED, peer, &size) != 0) return -errno;
  a->owner = peer[1];
  if (!sf_i_owner_ok(owner, SF_CAST(uid_t, peer[1]))) return -EPERM;
  setsockopt(a->sock, SOL_SOCKET, SFA_I_SO_PASSRIGHTS, &yes, sizeof yes);
  return 0;
}

/* One look for the server of `a->name`, and the whole greeting: 0 or a negative result. */
static inline int sfa_i_attach_once(sfa_client *a, int timeout_ms, int64_t owner) {
  int fds[2] = {-1, -1}, n, err = sfa_i_connect(a, timeout_ms, owner);
  if (err == 0) err = sfa_i_greet(a, a->client, fds);
  if (err == 0) err = sfa_i_map(a, fds);
  for (n = 0; n < 2; n++)
    if (fds[n] >= 0) close(fds[n]);
  if (err == 0) err = sfa_i_enter(a);
  if (err != 0) sfa_detach(a);
  return err;
}

#define SFA_I_POLL_NS 10000000 /* between looks for a server that has not started */

/*
 * Attach to arbiter `name` as `client`, a name that its configuration declares; wait up to `timeout_ms` for a server
 * that has not started (0: one look). Trust no server but that of user number `owner` (SF_OWNER_DEFAULT: this
 * process's own user, root, or the one that SURFFOLLOW_OWNER names).
 * Returns 0; -ENOENT no such arbiter, -EPERM that of another user (in `a->owner`), -EPROTO another release,
 * SFA_REFUSED - SFA_HELLO_...: refused.
 */
static inline int sfa_attach_owner(sfa_client *a, const char *name, const char *client, int timeout_ms, int64_t owner) {
  const int64_t deadline = sf_now_ns() + SF_CAST(int64_t, timeout_ms) * 1000000;
  int64_t left = 0;
  int err;
  memset(a, 0, sizeof *a);
  a->sock = -1;
  a->owner = -1;
  if (name == NULL || name[0] == '\0' || client == NULL || strlen(name) >= sizeof a->name ||
      strlen(client) >= sizeof a->client)
    return -EINVAL;
  memcpy(a->name, name, strlen(name));
  memcpy(a->client, client, strlen(client));
  for (;;) {
    err = sfa_i_attach_once(a, timeout_ms, owner);
    left = deadline - sf_now_ns();
    if (err != -ENOENT || left <= 0) return err;
    sf_sleep_until_ns(sf_now_ns() + (left < SFA_I_POLL_NS ? left : SFA_I_POLL_NS));
    left = deadline - sf_now_ns();
    timeout_ms = left > 0 ? SF_CAST(int, left / 1000000) : 0;
  }
}

/* sfa_attach_owner with SF_OWNER_DEFAULT. */
static inline int sfa_attach(sfa_client *a, const char *name, const char *client, int timeout_ms) {
  return sfa_attach_owner(a, name, client, timeout_ms, SF_OWNER_DEFAULT);
}

/*
 * After the server's end: detach, and attach under the same names, to a server of the same user only.
 * It waits like sfa_attach_owner: a control loop gives timeout_ms 0. Results as of sfa_attach_owner; after an error it
 * may be called again: until then the client holds nothing, and each call says so. Every token is void: ask again.
 */
static inline int sfa_reattach(sfa_client *a, int timeout_ms) {
  const int64_t owner = a->owner;
  sfa_client fresh;
  int err;
  sfa_detach(a);
  err = sfa_attach_owner(&fresh, a->name, a->client, timeout_ms, owner);
  if (err == 0) *a = fresh;
  return err;
}

static inline const sfa_resource_config *sfa_i_config(const sfa_client *a, int64_t resource) {
  return SF_VIEW(const sfa_resource_config *,
                 a->board + SFA_CONFIG_AT + SF_CAST(size_t, resource) * sizeof(sfa_resource_config));
}

/* Number of a resource, -EINVAL: there is none of that name, or -ENOENT: the client is not attached. */
static inline int sfa_resource(const sfa_client *a, const char *name) {
  const sfa_board_header *h = SF_VIEW(const sfa_board_header *, a->board);
  int64_t r;
  if (a->board == NULL) return -ENOENT;
  if (name == NULL) return -EINVAL;
  for (r = 0; r < h->n_resources && r < SFA_RESOURCES; r++) {
    if (strncmp(sfa_i_config(a, r)->name, name, sizeof sfa_i_config(a, r)->name) == 0) return SF_CAST(int, r);
  }
  return -EINVAL;
}

/* Whether this client is attached, and not a forked child's copy of its parent's. */
static inline int sfa_i_is_ours(const sfa_client *a) { return a->board != NULL && *a->ours != 0; }

/* Renew the lease of this client. */
static inline void sfa_heartbeat(sfa_client *a) {
  if (!sfa_i_is_ours(a)) return;
  sf_store_relaxed(a->mailbox + offsetof(sfa_mailbox, heartbeat_ns), sf_now_ns());
}

#define sfa_beat sfa_heartbeat /* the name before release 0.1.0, for one release */

/* A server looks at the mailbox of a holder once in its period: one that did not for a lease is no more. */
static inline int sfa_i_is_silent(const sfa_client *a, int64_t now) {
  return now - sf_load_relaxed(a->board + offsetof(sfa_board_header, heartbeat_ns)) > a->lease_ns;
}

static inline int64_t sfa_i_token(const sfa_client *a, int resource) {
  if (resource < 0 || resource >= SFA_RESOURCES || !sfa_i_is_ours(a)) return 0;
  return sf_load_acquire(a->board + a->grants_at + offsetof(sfa_client_grants, held) + 8 * SF_CAST(size_t, resource));
}

/*
 * The token of a resource that this client holds, 0: none, or the server was silent for a lease; none in a forked
 * child, which attaches for itself, or behind sfa_detach. From memory, never waits.
 */
static inline int64_t sfa_held(const sfa_client *a, int resource) {
  const int64_t token = sfa_i_token(a, resource);
  return token != 0 && sfa_i_is_silent(a, sf_now_ns()) ? 0 : token;
}

/* Whether the server asks this holder to relinquish (cooperative policy). */
static inline int sfa_asked(const sfa_client *a, int resource) {
  if (resource < 0 || resource >= SFA_RESOURCES || a->board == NULL) return 0;
  return sf_load_acquire(a->board + a->grants_at + offsetof(sfa_client_grants, asked) + 8 * SF_CAST(size_t, resource)) != 0;
}

/* Whether the server ended, or was replaced: then detach and attach again. */
static inline int sfa_ended(const sfa_client *a) {
  char byte;
  const ssize_t got = recv(a->sock, &byte, 1, MSG_PEEK | MSG_DONTWAIT);
  return got == 0 || (got < 0 && errno != EAGAIN && errno != EWOULDBLOCK && errno != EINTR);
}

/* Status of a resource: 1, or 0 when there is none whole yet. */
static inline int sfa_status(const sfa_client *a, int resource, sfa_resource_status *out) {
  if (resource < 0 || resource >= SFA_RESOURCES || a->board == NULL) return 0;
  return sf_latch_read(a->board + a->status_at + SF_CAST(size_t, resource) * SFA_STATUS_BYTES, sizeof *out, out) > 0;
}

/*
 * Since when a part of a sum is lost (CLOCK_MONOTONIC, ns), 0: it is not. The sum is its safe command until a client is
 * granted the part.
 */
static inline int64_t sfa_lost_since(const sfa_client *a, int resource) {
  int64_t lost_ns;
  if (resource < 0 || resource >= SFA_RESOURCES || a->board == NULL) return 0;
  lost_ns = sf_load_acquire(a->board + offsetof(sfa_board_header, lost_ns) + 8 * SF_CAST(size_t, resource));
  return lost_ns > 0 ? lost_ns : 0;
}

static inline int sfa_i_post(sfa_client *a, int64_t what, int64_t token, int64_t now, const double *values, int n,
                             int64_t ref_t_ns, const double *ref_pose) {
  unsigned char *item;
  int k;
  if (!sfa_i_is_ours(a)) return -ENOENT;
  item = a->mailbox + offsetof(sfa_mailbox, item) +
         sizeof(sfa_item) * SF_CAST(size_t, a->head & (SFA_MAILBOX_ITEMS - 1));
  if (a->head - sf_load_acquire(a->board + a->entry_at + offsetof(sfa_client_entry, consumed)) >= SFA_MAILBOX_ITEMS)
    return -EAGAIN;
  sf_store_relaxed(item + offsetof(sfa_item, seq), a->head + 1);
  sf_store_relaxed(item + offsetof(sfa_item, what), what);
  sf_store_relaxed(item + offsetof(sfa_item, token), token);
  sf_store_relaxed(item + offsetof(sfa_item, t_ns), now);
  sf_store_relaxed(item + offsetof(sfa_item, ref_t_ns), ref_t_ns);
  for (k = 0; k < n; k++) {
    int64_t word;
    memcpy(&word, values + k, 8);
    sf_store_relaxed(item + offsetof(sfa_item, value) + 8 * SF_CAST(size_t, k), word);
  }
  for (k = 0; ref_t_ns != 0 && k < SFA_POSE; k++) {
    int64_t word = 0; /* no pose, and not what the place held before */
    if (ref_pose != NULL) memcpy(&word, ref_pose + k, 8);
    sf_store_relaxed(item + offsetof(sfa_item, ref_pose) + 8 * SF_CAST(size_t, k), word);
  }
  a->head++;
  sf_store_release(a->mailbox + offsetof(sfa_mailbox, head), a->head);
  sf_store_relaxed(a->mailbox + offsetof(sfa_mailbox, heartbeat_ns), now);
  return 0;
}

/*
 * Command a resource that this client holds: `n` values, as many as the resource declares, relative to the
 * pose of `ref_t_ns` (0: none; then `ref_pose` is NULL). Never waits.
 * Returns 1; 0: the resource is not ours (any more), nothing was sent; -EAGAIN: the mailbox is full; -ENOENT: the
 * server was silent for a lease; -EINVAL: no such resource, no values or another number of them, or a pose without
 * its time.
 */
static inline int sfa_command_at(sfa_client *a, int resource, const double *values, int n, int64_t ref_t_ns,
                                 const double *ref_pose) {
  const int64_t token = sfa_i_token(a, resource), now = sf_now_ns();
  int err;
  if (resource < 0 || resource >= SFA_RESOURCES) return -EINVAL;
  if (token == 0) return 0;
  if (n != sfa_i_config(a, resource)->n_values || n > SFA_VALUES) return -EINVAL;
  if ((ref_t_ns == 0 && ref_pose != NULL) || (n > 0 && values == NULL)) return -EINVAL;
  if (sfa_i_is_silent(a, now)) return -ENOENT;
  err = sfa_i_post(a, SFA_ITEM_COMMAND | SF_CAST(int64_t, resource) << 8, token, now, values, n, ref_t_ns, ref_pose);
  return err == 0 ? 1 : err;
}

/* The same, relative to no pose. */
static inline int sfa_command(sfa_client *a, int resource, const double *values, int n) {
  return sfa_command_at(a, resource, values, n, 0, NULL);
}

/* Post a request or relinquishment and ring. */
static inline int sfa_i_tell(sfa_client *a, int64_t what) {
  const int err = sfa_i_post(a, what, 0, sf_now_ns(), NULL, 0, 0, NULL);
  unsigned char *doorbell;
  if (err != 0) return err;
  doorbell = a->mailbox + offsetof(sfa_mailbox, doorbell);
  sf_store_release(doorbell, sf_load_relaxed(doorbell) + 1);
  sfa_i_futex(doorbell, 1, 0, 0);
  return 0;
}

/* The same, and wait for the answer to it. */
static inline int sfa_i_ask(sfa_client *a, int64_t what, int64_t deadline, sfa_reply *reply) {
  const unsigned char *doorbell;
  int64_t rung, seq;
  int err;
  if (!sfa_i_is_ours(a)) return -ENOENT;
  doorbell = a->board + a->grants_at + offsetof(sfa_client_grants, doorbell);
  rung = sf_load_acquire(doorbell);
  err = sfa_i_tell(a, what);
  if (err != 0) return err;
  seq = a->head;
  for (;;) {
    const int64_t got = sf_latch_read(a->board + a->reply_at, sizeof *reply, reply);
    int64_t left;
    if (got > 0 && reply->seq == seq) return 0;
    left = deadline - sf_now_ns();
    if (left <= 0) return sfa_ended(a) ? -ENOENT : -ETIMEDOUT;
    if (left > 50000000) left = 50000000;
    sfa_i_futex(doorbell, 0, rung, left);
    rung = sf_load_acquire(doorbell);
    sfa_heartbeat(a);
  }
}

/* Give control back, or leave the queue: 0 or a negative result. */
static inline int sfa_relinquish(sfa_client *a, int resource) {
  sfa_reply reply;
  if (resource < 0 || resource >= SFA_RESOURCES) return -EINVAL;
  return sfa_i_ask(a, SFA_ITEM_RELINQUISH | SF_CAST(int64_t, resource) << 8, sf_now_ns() + 1000000000, &reply);
}

/*
 * Ask for control; `wait` not 0: stand in the queue until then.
 * Returns 1: granted; 0: denied (`reply`, may be NULL, says who holds it); below 0 an error. After -ETIMEDOUT the
 * request is withdrawn: a server that answers later grants nothing.
 */
static inline int sfa_request(sfa_client *a, int resource, int wait, int timeout_ms, sfa_reply *reply) {
  const int64_t deadline = sf_now_ns() + SF_CAST(int64_t, timeout_ms) * 1000000;
  const int64_t before = sfa_i_token(a, resource);
  const unsigned char *doorbell;
  sfa_reply own;
  int err;
  if (resource < 0 || resource >= SFA_RESOURCES) return -EINVAL;
  if (!sfa_i_is_ours(a)) return -ENOENT;
  doorbell = a->board + a->grants_at + offsetof(sfa_client_grants, doorbell);
  if (reply == NULL) reply = &own;
  err = sfa_i_ask(a, SFA_ITEM_REQUEST | SF_CAST(int64_t, resource) << 8 | (wait ? 1 << 16 : 0), deadline, reply);
  if (err == -ETIMEDOUT && before == 0) (void)sfa_i_tell(a, SFA_ITEM_RELINQUISH | SF_CAST(int64_t, resource) << 8);
  if (err != 0) return err;
  if (reply->result == SFA_GRANT || reply->result == SFA_KEEP) return 1;
  if (reply->result != SFA_ENQUEUE) return 0;
  for (;;) {
    const int64_t rung = sf_load_acquire(doorbell);
    int64_t left;
    if (sfa_held(a, resource) != 0) return 1;
    left = deadline - sf_now_ns();
    if (left <= 0 || sfa_ended(a)) break;
    sfa_i_futex(doorbell, 0, rung, left < 50000000 ? left : 50000000);
    sfa_heartbeat(a);
  }
  err = sfa_relinquish(a, resource); /* leave the queue; a grant on the last moment is given back */
  return err;
}
