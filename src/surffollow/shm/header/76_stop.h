/* ---- stop ----------------------------------------------------------------------------------- */

static inline int sf_stop_now(sf_client *c);

/*
 * Stop: from the next cycle on no demand is valid (SF_STOPPED), until the client that sends the pose calls
 * sf_stop_reset. Any client may ask; `reason` (may be NULL) is kept in the audit trail, its first 63 bytes.
 * What the controller does then stands in docs/reference/protocol.md. This is no safety function.
 */
static inline int sf_stop(sf_client *c, const char *reason) {
  if (c == NULL) return SF_ERR_ARGUMENT;
  (void)sf_stop_now(c); /* in force from the next cycle on; the request brings the reason and an answer */
  int64_t words[SF_STOP_TEXT_WORDS];
  memset(words, 0, sizeof words);
  if (reason != NULL) memcpy(words, reason, strnlen(reason, sizeof words - 1));
  return sf_i_request(c, SF_RQ_STOP, SF_STOP_TEXT_WORDS, words, NULL, c->options.timeout_ns);
}

/*
 * Stop by one store into the slot, which the service looks at in every cycle. Never waits, needs no turn and gets no
 * answer; may be called in a signal handler. SF_OK, or SF_ERR_NOT_RUNNING: there is no slot.
 */
static inline int sf_stop_now(sf_client *c) {
  if (c == NULL) return SF_ERR_ARGUMENT;
  if (c->slot_memory == NULL) return SF_ERR_NOT_RUNNING;
  int64_t *word = &SF_VIEW(sf_slot_head *, c->slot_memory + SF_SLOT_HEAD)->stop;
  const uint64_t count = SF_CAST(uint64_t, sf_load_acquire(word)) >> 32;
  sf_store_release(word, SF_CAST(int64_t, ((count + 1) & 0x7FFFFFFF) << 32 | SF_STOP_WORD));
  return SF_OK;
}

/*
 * Leave the latched stop; the forecast restarts with the stand-off in force. SF_OK, SF_REFUSED_NOT_POSE_HOLDER
 * (`detail` of the client: the pose's holder, 0: none), or SF_REFUSED_STOP_REMAINS (`detail`: SF_STOP_... causes).
 * After a restart of the service (cause SF_STOP_RESTART) the stand-off and all parameters are those of its
 * configuration: call sf_sf_reset and sf_set_params with yours first. sf_read_params reads those in force.
 */
static inline int sf_stop_reset(sf_client *c) {
  if (c == NULL) return SF_ERR_ARGUMENT;
  return sf_i_request(c, SF_RQ_STOP_RESET, 0, NULL, NULL, c->options.timeout_ns);
}

