/* ---- ranges of an own sensor ([driver] kind = "external"; docs/reference/protocol.md, "Pushed ranges") ----- */

/* The value for "the sensor sees nothing", safe with -ffast-math. */
static inline double sf_no_reading(void) {
  const uint64_t nan_bits = UINT64_C(0x7FF8000000000000);
  double value;
  memcpy(&value, &nan_bits, sizeof value);
  return value;
}

/* Become the one who pushes a channel's ranges; sf_push_range does it when needed. Waits for the answer. */
static inline int sf_claim_range(sf_client *c, int channel) {
  if (c == NULL || channel < 0 || channel >= SF_CHANNELS) return SF_ERR_ARGUMENT;
  if (c->ranges_held >> channel & 1) return SF_OK;
  return sf_i_claim(c, SF_RQ_CLAIM_RANGE, channel);
}

/* Let another client push a channel's ranges. */
static inline int sf_release_range(sf_client *c, int channel) {
  if (c == NULL || channel < 0 || channel >= SF_CHANNELS) return SF_ERR_ARGUMENT;
  if (c->output != NULL) sf_i_follow(c, sf_now_ns()); /* of a service started anew this client holds nothing */
  c->had_ranges &= ~(1 << channel);
  if ((c->ranges_held >> channel & 1) == 0) return SF_OK;
  c->ranges_held &= ~(1 << channel);
  const int64_t number = channel;
  return sf_i_ask(c, SF_RQ_RELEASE_RANGE, 1, &number, NULL, c->options.timeout_ns, 0);
}

/*
 * Hand the service one range of an own sensor [m], true at `t_ns` (SF_NOW: now); sf_no_reading(), NaN or
 * infinite: it sees nothing. The first range of a channel claims it and waits for the answer (sf_claim_range does that
 * beforehand). No later one waits, in any state of the service or its socket, and none makes a system call but the
 * clock's unless the service is silent or its slot is lost.
 * SF_OK, SF_ERR_RANGE_TIME, _ARGUMENT, _OBSERVER, _NOT_RUNNING (it ended, or slot and channel are being asked for
 * anew of one that was started again: call again); SF_REFUSED_RANGE_HELD with the holder's pid in
 * the client's `detail`, and the service is asked again once in SF_REFUSED_NS, without waiting; SF_REFUSED_NO_CHANNEL: the service's driver takes no pushed ranges on this channel.
 */
static inline int sf_push_range(sf_client *c, int channel, int64_t t_ns, double range_m) {
  if (c == NULL || c->output == NULL || channel < 0 || channel >= SF_CHANNELS) return SF_ERR_ARGUMENT;
  if (c->options.observe) return SF_ERR_OBSERVER;
  const int64_t now = sf_now_ns();
  if (now > c->next_look_ns && sf_i_look_after(c, now) != SF_OK) return SF_ERR_NOT_RUNNING;
  if (t_ns == SF_NOW) t_ns = now;
  if (t_ns > now + SF_RANGE_FUTURE_NS || t_ns < now - SF_RANGE_OLDEST_NS) return SF_ERR_RANGE_TIME;
  if ((c->ranges_held >> channel & 1) == 0) {
    const int claimed = sf_i_claim_in_loop(c, SF_RQ_CLAIM_RANGE, channel, c->had_ranges >> channel & 1, now);
    if (claimed != SF_OK) return claimed;
  }
  if (t_ns <= c->pushed_ns[channel]) return SF_ERR_RANGE_TIME;
  c->pushed_ns[channel] = t_ns;
  unsigned char *ring = c->slot_memory + SF_SLOT_RANGES;
  const int64_t head = sf_load_relaxed(ring);
  unsigned char *item = ring + SF_RANGES_AT + sizeof(sf_range_item) * SF_CAST(size_t, head & (SF_RANGE_ITEMS - 1));
  const int64_t number = SF_CAST(int64_t, SF_CAST(uint64_t, head) + 1u); /* may be anything, wraps */
  int64_t bits;
  memcpy(&bits, &range_m, sizeof bits);
  __atomic_thread_fence(__ATOMIC_RELEASE); /* P1 */
  sf_store_relaxed(item + offsetof(sf_range_item, number), number); /* P2 */
  sf_store_relaxed(item + offsetof(sf_range_item, t_ns), t_ns);
  sf_store_relaxed(item + offsetof(sf_range_item, channel), channel);
  sf_store_relaxed(item + offsetof(sf_range_item, range_m), bits);
  sf_store_release(ring, number); /* P3 */
  return SF_OK;
}

