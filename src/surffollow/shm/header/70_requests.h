/* ---- requests and their answers ------------------------------------------------------------- */

/* A request on its way. */
typedef struct sf_ticket {
  int64_t counter, claim;
} sf_ticket;

static inline int sf_i_read_ack(const unsigned char *acks, int slot, sf_ack *ack) {
  const size_t step = SF_CAST(size_t, sf_i_latch_bytes(sizeof *ack));
  return sf_latch_read(acks + step * SF_CAST(size_t, slot), sizeof *ack, ack) > 0;
}

/*
 * Send a request without waiting: `code` SF_RQ_..., up to SF_REQUEST_ARGS numbers and values. SF_ERR_NOT_RUNNING
 * also while a service that was started anew has not handed out a slot: call it again.
 * SF_ERR_BUSY while the last one is not acknowledged: a second one could overtake it unseen.
 */
static inline int sf_request_send(sf_client *c, int64_t code, int n, const int64_t *numbers, const double *values,
                                  sf_ticket *ticket) {
  if (c == NULL || c->output == NULL || ticket == NULL || n < 0 || n > SF_REQUEST_ARGS) return SF_ERR_ARGUMENT;
  if (c->options.observe) return SF_ERR_OBSERVER;
  if (!sf_alive(c)) return SF_ERR_NOT_RUNNING;
  const int slot = sf_i_ensure_slot(c);
  if (slot != SF_OK) return slot == SF_ERR_NOT_READY ? SF_ERR_NOT_RUNNING : slot;
  const int64_t now = sf_now_ns();
  sf_ack last;
  /* one that was lost with its service's start must not block all later ones */
  if (c->counter > 0 && !c->abandoned && now < c->asked_ns + c->options.timeout_ns &&
      !(sf_i_read_ack(c->acks, c->slot, &last) && last.counter == c->counter && last.claim == c->claim))
    return SF_ERR_BUSY;
  sf_request_post r;
  memset(&r, 0, sizeof r);
  r.counter = ++c->counter;
  r.code = code;
  r.n = n;
  r.claim = c->claim;
  for (int k = 0; k < n; k++) {
    if (numbers != NULL) r.number[k] = numbers[k];
    if (values != NULL) r.value[k] = values[k];
  }
  c->abandoned = 0;
  c->asked_ns = now;
  sf_latch_write(c->slot_memory + SF_SLOT_REQUEST, sizeof r, &r);
  ticket->counter = r.counter;
  ticket->claim = r.claim;
  return SF_OK;
}

/*
 * Look for the answer to a request, without waiting.
 * SF_OK, SF_PENDING, SF_ERR_RESTARTED, SF_ERR_NOT_RUNNING when the service ended, or SF_REFUSED_...; the
 * client's `detail` holds its number.
 */
static inline int sf_request_poll(sf_client *c, const sf_ticket *ticket) {
  if (c == NULL || c->output == NULL || ticket == NULL || ticket->counter < 1) return SF_ERR_ARGUMENT;
  const int there = sf_i_follow(c, sf_now_ns()); /* before the look for an answer: it may be its last word */
  if (c->slot_memory == NULL || ticket->claim != c->claim) return SF_ERR_RESTARTED;
  for (int k = 0; k < 2; k++) {
    sf_ack a;
    if (!sf_i_read_ack(k == 0 ? c->acks : c->map_acks, c->slot, &a)) continue;
    if (a.counter != ticket->counter || a.claim != ticket->claim || a.result == SF_ANSWER_ACCEPTED) continue;
    c->detail = a.detail;
    if (a.result == SF_ANSWER_OK) return SF_OK;
    return a.result > 0 && a.result < SF_ANSWERS ? SF_REFUSED - SF_CAST(int, a.result) : SF_ERR_BLOCK;
  }
  return there == SF_OK ? SF_PENDING : there;
}

/* Wait for the answer; as sf_request_poll, or SF_ERR_TIMEOUT (SF_ERR_NOT_RUNNING: the service is silent, too). */
static inline int sf_request_wait(sf_client *c, const sf_ticket *ticket, int64_t timeout_ns) {
  const int64_t deadline = sf_now_ns() + sf_i_wait_ns(timeout_ns);
  int64_t pause_ns = 50000;
  for (;;) {
    const int result = sf_request_poll(c, ticket);
    const int64_t now = sf_now_ns();
    const int over = result == SF_PENDING && now >= deadline;
    if (over || result == SF_ERR_NOT_RUNNING) c->abandoned = 1; /* the next request need not wait for this one */
    if (over) return sf_i_is_silent(c, now) ? SF_ERR_NOT_RUNNING : SF_ERR_TIMEOUT;
    if (result != SF_PENDING) return result;
    sf_sleep_until_ns(now + pause_ns < deadline ? now + pause_ns : deadline);
    if (pause_ns < 2000000) pause_ns *= 2;
  }
}

/*
 * Wait for the slot's turn, send, and wait for the answer; `stall_ns`: how long a service may stand still that has
 * not ended.
 */
static inline int sf_i_ask(sf_client *c, int64_t code, int n, const int64_t *numbers, const double *values,
                           int64_t timeout_ns, int64_t stall_ns) {
  sf_ticket ticket;
  const int64_t asked = sf_now_ns();
  for (;;) {
    const int err = sf_request_send(c, code, n, numbers, values, &ticket);
    if (err == SF_OK) return sf_request_wait(c, &ticket, timeout_ns);
    const int64_t now = sf_now_ns();
    /* the request before this one may be on its way: one more cycle */
    const int again = err == SF_ERR_BUSY ? now < asked + timeout_ns
                                         : err == SF_ERR_NOT_RUNNING && now < asked + stall_ns;
    if (!again || sf_i_follow(c, now) != SF_OK) return err;
    sf_sleep_until_ns(now + (err == SF_ERR_BUSY ? 100000 : 1000000));
  }
}

static inline int sf_i_request(sf_client *c, int64_t code, int n, const int64_t *numbers, const double *values,
                               int64_t timeout_ns) {
  return sf_i_ask(c, code, n, numbers, values, timeout_ns, timeout_ns);
}

/* Restart the forecast with a desired stand-off [m] (paper: SFReset). A latched stop stays: sf_stop_reset ends it. */
static inline int sf_sf_reset(sf_client *c, double offset_m) {
  if (c == NULL) return SF_ERR_ARGUMENT;
  return sf_i_request(c, SF_RQ_SF_RESET, 1, NULL, &offset_m, c->options.timeout_ns);
}

#define SF_I_CLAIM_PAUSE_NS 20000000 /* the first pause behind a refusal; the later ones double */

static inline sf_i_refusal *sf_i_refusal_of(sf_client *c, int64_t code, int64_t channel) {
  return code == SF_RQ_CLAIM_POSE ? &c->pose_refusal : &c->range_refusals[channel];
}

/* The pose (SF_RQ_CLAIM_POSE) or a channel (SF_RQ_CLAIM_RANGE) is this client's. */
static inline void sf_i_hold(sf_client *c, int64_t code, int64_t channel) {
  memset(sf_i_refusal_of(c, code, channel), 0, sizeof(sf_i_refusal));
  if (code == SF_RQ_CLAIM_POSE) {
    c->pose_held = c->had_pose = 1;
    c->pose_held_ns = sf_now_ns();
  } else {
    c->ranges_held |= 1 << channel;
    c->had_ranges |= 1 << channel;
    c->pushed_ns[channel] = INT64_MIN;
  }
}

/*
 * One step in a control loop towards what a restart of the service took; never waits. The slot carries one request
 * at a time: the answer to any claim under way is taken before another one is sent.
 * SF_OK, SF_ERR_NOT_RUNNING: not there yet, SF_REFUSED_...
 */
static inline int sf_i_reclaim(sf_client *c, int64_t code, int64_t channel, int64_t now_ns) {
  sf_i_claiming *under_way = &c->claiming;
  sf_ticket ticket;
  if (c->slot_memory == NULL || under_way->claim != c->claim) under_way->counter = 0;
  if (under_way->counter != 0) {
    ticket.counter = under_way->counter;
    ticket.claim = under_way->claim;
    const int result = sf_request_poll(c, &ticket);
    if (result == SF_PENDING && now_ns <= under_way->asked_ns + SF_EXCHANGE_NS) return SF_ERR_NOT_RUNNING;
    under_way->counter = 0;
    if (result == SF_PENDING) c->abandoned = 1;
    if (result == SF_OK) sf_i_hold(c, under_way->code, under_way->channel);
    if (result != SF_PENDING && under_way->code == code && under_way->channel == channel)
      return result == SF_ERR_RESTARTED ? SF_ERR_NOT_RUNNING : result;
  }
  const int err = sf_request_send(c, code, code == SF_RQ_CLAIM_RANGE, &channel, NULL, &ticket);
  if (err != SF_OK) return err == SF_ERR_BUSY ? SF_ERR_NOT_RUNNING : err;
  under_way->code = code;
  under_way->channel = channel;
  under_way->counter = ticket.counter;
  under_way->claim = ticket.claim;
  under_way->asked_ns = now_ns;
  return SF_ERR_NOT_RUNNING;
}

/*
 * Claim what another client may hold, and wait for the answer. The service looks for dead holders at its own pace: it
 * is given 0.3 s.
 */
static inline int sf_i_claim(sf_client *c, int64_t code, int64_t channel) {
  const int64_t deadline = sf_now_ns() + 300000000;
  int64_t pause_ns = SF_I_CLAIM_PAUSE_NS;
  for (;;) {
    const int result =
        sf_i_ask(c, code, code == SF_RQ_CLAIM_RANGE, &channel, NULL, c->options.timeout_ns, 0);
    const int64_t now = sf_now_ns();
    if (result == SF_OK) sf_i_hold(c, code, channel);
    if (result != SF_REFUSED_POSE_HELD && result != SF_REFUSED_RANGE_HELD) return result;
    if (now >= deadline) {
      sf_i_refusal *refusal = sf_i_refusal_of(c, code, channel);
      refusal->pause_ns = SF_REFUSED_NS;
      refusal->until_ns = now + SF_REFUSED_NS;
      refusal->pid = c->detail;
      return result;
    }
    sf_sleep_until_ns(now + pause_ns < deadline ? now + pause_ns : deadline);
    pause_ns *= 2;
  }
}

/* Become the one who sends the pose; sf_ee_pos does it when needed. Waits for the service's answer. */
static inline int sf_claim_pose(sf_client *c) {
  if (c == NULL) return SF_ERR_ARGUMENT;
  if (c->pose_held) return SF_OK;
  const int64_t now = sf_now_ns();
  if (c->output != NULL && !c->options.observe && c->slot_memory == NULL && c->options.auto_reattach && sf_alive(c))
    (void)sf_i_claim_slot(c, now + SF_EXCHANGE_NS); /* an error of it is reported below */
  return sf_i_claim(c, SF_RQ_CLAIM_POSE, 0);
}

/*
 * One step in a control loop towards the pose or a channel: the first claim waits (`had`: it was held before), no later
 * one does. While another client holds it the service is asked once in SF_REFUSED_NS, and the calls between are refused.
 */
static inline int sf_i_claim_in_loop(sf_client *c, int64_t code, int64_t channel, int had, int64_t now_ns) {
  sf_i_refusal *refusal = sf_i_refusal_of(c, code, channel);
  const int held = code == SF_RQ_CLAIM_POSE ? SF_REFUSED_POSE_HELD : SF_REFUSED_RANGE_HELD;
  if (now_ns < refusal->until_ns) {
    c->detail = refusal->pid;
    return held;
  }
  if (!had && refusal->pause_ns == 0) return code == SF_RQ_CLAIM_POSE ? sf_claim_pose(c) : sf_i_claim(c, code, channel);
  const int result = sf_i_reclaim(c, code, channel, now_ns);
  if (result == held) {
    const int64_t pause_ns = refusal->pause_ns > 0 ? 2 * refusal->pause_ns : SF_I_CLAIM_PAUSE_NS;
    refusal->pause_ns = pause_ns < SF_REFUSED_NS ? pause_ns : SF_REFUSED_NS;
    refusal->until_ns = now_ns + refusal->pause_ns;
    refusal->pid = c->detail;
  }
  if (result != SF_ERR_NOT_RUNNING || refusal->pause_ns == 0 || c->claiming.counter == 0) return result;
  c->detail = refusal->pid; /* the service is there and has not answered yet */
  return held;
}

/* Let another client send the pose. */
static inline int sf_release_pose(sf_client *c) {
  if (c == NULL) return SF_ERR_ARGUMENT;
  if (c->output != NULL) sf_i_follow(c, sf_now_ns()); /* of a service started anew this client holds nothing */
  c->had_pose = 0;
  if (!c->pose_held) return SF_OK;
  c->pose_held = 0;
  return sf_i_ask(c, SF_RQ_RELEASE_POSE, 0, NULL, NULL, c->options.timeout_ns, 0);
}

/* Release what this client holds or is claiming, so that its end is no loss; a service that is silent is not waited for. */
static inline void sf_i_give_pose_back(sf_client *c) {
  if (c->slot_memory == NULL || !c->had_pose || !sf_i_slot_is_open(c)) return;
  const int64_t timeout_ns = c->options.timeout_ns < SF_EXCHANGE_NS ? c->options.timeout_ns : SF_EXCHANGE_NS;
  c->had_pose = c->pose_held = 0;
  (void)sf_i_ask(c, SF_RQ_RELEASE_POSE, 0, NULL, NULL, timeout_ns, 0);
}

/* Check a pose; a quaternion's norm may be off by 1e-3 and is then made 1. */
static inline int sf_i_check_pose(const double pose[7], double out[7]) {
  double norm2 = 0.0;
  for (int k = 0; k < 7; k++) {
    if (!sf_i_is_finite(pose[k])) return SF_ERR_POSE;
    out[k] = pose[k];
    if (k < 3 && !(pose[k] > -SF_MAX_POSITION_M && pose[k] < SF_MAX_POSITION_M)) return SF_ERR_POSE;
    if (k >= 3) norm2 += pose[k] * pose[k];
  }
  const double off = norm2 - 1.0;
  if (off > -2e-15 && off < 2e-15) return SF_OK;
  if (!(norm2 >= 0.998001 && norm2 <= 1.002001)) return SF_ERR_POSE; /* (1 -+ 1e-3)^2 */
  double norm = 0.5 * (1.0 + norm2); /* Newton from within 1e-6: exact after two steps, and no libm */
  norm = 0.5 * (norm + norm2 / norm);
  norm = 0.5 * (norm + norm2 / norm);
  for (int k = 3; k < 7; k++) out[k] /= norm;
  return SF_OK;
}

/* Ten times a second: whether the slot and the pose are ours still. */
static inline void sf_i_look_at_slot(sf_client *c, int64_t now_ns) {
  sf_main_thread_state t;
  c->next_life_ns = now_ns + SF_LOOK_EVERY_NS;
  sf_i_read_pose_timeout(c);
  if (c->slot_memory == NULL) return;
  if (!sf_i_slot_is_open(c)) { /* the service took it back: the next pose or request asks for another */
    sf_i_release_slot(c);
    if (!c->options.auto_reattach) c->ended = sf_i_has_ended(c); /* nothing asks for another one */
    return;
  }
  const size_t words = offsetof(sf_main_thread_state, pose_pid) / 8;
  if (!c->pose_held || sf_latch_read_part(c->ticker, sizeof t, 0, words, &t) <= 0) return;
  if (t.pose_slot != c->slot && t.t_ns > c->pose_held_ns + SF_LOOK_EVERY_NS) c->pose_held = 0; /* ask again */
}

/* As often as a service falls silent: whether it is there. SF_OK or SF_ERR_NOT_RUNNING. */
static inline int sf_i_look_after(sf_client *c, int64_t now_ns) {
  c->next_look_ns = 0;
  const int there = sf_i_follow(c, now_ns);
  if (there != SF_OK) return there;
  c->next_look_ns = now_ns + (c->stale_ns < SF_LOOK_EVERY_NS ? c->stale_ns : SF_LOOK_EVERY_NS);
  if (now_ns > c->next_life_ns) sf_i_look_at_slot(c, now_ns);
  return SF_OK;
}

#define SF_NOW INT64_MIN

/*
 * Report the pose of the tool, now or at a past time: x y z [m], unit quaternion qx qy qz qw, world from tool,
 * z of the world up, beams along -z of their sensors; the measured pose, not the commanded one, true at `t_ns`
 * (SF_NOW: now) (docs/explanation/frames.md). The first call of an attachment claims the pose and waits for the answer
 * (sf_claim_pose does that beforehand). No later one waits, in any state of the service or its socket, and none makes
 * a system call but the clock's unless the service is silent or its slot is lost.
 * SF_OK, SF_ERR_POSE, _POSE_FUTURE, _POSE_OLD, _OBSERVER, _NOT_RUNNING (it ended, or slot and pose are being asked
 * for anew of one that was started again: call again), or SF_REFUSED_POSE_HELD with the holder's pid in the client's
 * `detail`: the service is then asked again once in SF_REFUSED_NS, without waiting.
 */
static inline int sf_ee_pos(sf_client *c, const double pose[7], int64_t t_ns) {
  if (c == NULL || c->output == NULL || pose == NULL) return SF_ERR_ARGUMENT;
  if (c->options.observe) return SF_ERR_OBSERVER;
  sf_pose_post post;
  const int err = sf_i_check_pose(pose, post.pose);
  if (err != SF_OK) return err;
  const int64_t now = sf_now_ns();
  if (now > c->next_look_ns && sf_i_look_after(c, now) != SF_OK) return SF_ERR_NOT_RUNNING;
  post.t_ns = t_ns == SF_NOW ? now : t_ns;
  if (post.t_ns > now + SF_POSE_FUTURE_NS) return SF_ERR_POSE_FUTURE;
  if (post.t_ns < now - c->pose_timeout_ns) return SF_ERR_POSE_OLD;
  if (!c->pose_held) {
    const int claimed = sf_i_claim_in_loop(c, SF_RQ_CLAIM_POSE, 0, c->had_pose, now);
    if (claimed != SF_OK) return claimed;
  }
  sf_latch_write(c->slot_memory + SF_SLOT_POSE, sizeof post, &post);
  return SF_OK;
}
