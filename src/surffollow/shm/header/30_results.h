/* ---- results ------------------------------------------------------------------------------- */

enum {
  SF_OK = 0,
  /* answers that are no errors */
  SF_NO_DEMAND = 1,  /* the demand is zero; its status says why */
  SF_PENDING = 2,    /* the service has not answered yet */
  SF_NO_READING = 3, /* no valid distance now */
  SF_UNKNOWN = 4,    /* no height known there */
  /* the call */
  SF_ERR_ARGUMENT = -1,
  SF_ERR_NAME = -2,
  SF_ERR_POSE = -3,
  SF_ERR_POSE_FUTURE = -4,
  SF_ERR_POSE_OLD = -5,
  SF_ERR_REGION = -6,
  SF_ERR_PARAM = -7,
  SF_ERR_BOUNDS = -8,
  SF_ERR_RANGE_TIME = -9,
  /* the world; `detail` of the client holds errno for SF_ERR_SYSTEM */
  SF_ERR_NOT_RUNNING = -20,
  SF_ERR_NO_PERMISSION = -21,
  SF_ERR_NOT_READY = -22,
  SF_ERR_LAYOUT = -23,
  SF_ERR_BLOCK = -24,
  SF_ERR_SLOTS = -25,
  SF_ERR_OBSERVER = -26,
  SF_ERR_TIMEOUT = -27,
  SF_ERR_RESTARTED = -28,
  SF_ERR_BUSY = -29,
  SF_ERR_TORN = -30,
  SF_ERR_ACCESS_LOST = -31,
  SF_ERR_FILE = -32,
  SF_ERR_MEMORY = -33,
  SF_ERR_SYSTEM = -34,
  SF_ERR_HELD = -35,
  SF_ERR_OWNER = -36,
  SF_ERR_WORLD_HELD = -37,
  /* the service refused: SF_REFUSED_...; `detail` of the client holds the answer's number */
  SF_REFUSED = -100
};

/* One English sentence for a result of any function here; never NULL. */
static inline const char *sf_strerror(int result) {
  switch (result) {
    case SF_OK: return "done";
    case SF_NO_DEMAND: return "the demand is zero; its status says why";
    case SF_PENDING: return "the service has not answered yet";
    case SF_NO_READING: return "there is no valid distance now";
    case SF_UNKNOWN: return "no height is known there";
    case SF_ERR_ARGUMENT: return "an argument is missing or outside its range";
    case SF_ERR_NAME: return "a service's name is 1 to 48 letters, digits, '.', '_' or '-', none of '._-' first, no .sock, .lock, .map, .stop or .world last";
    case SF_ERR_POSE: return "a pose is seven finite numbers: x y z within 1e9 m, a quaternion of norm 1 within 1e-3";
    case SF_ERR_POSE_FUTURE: return "the pose is stamped more than 1 ms ahead; use CLOCK_MONOTONIC";
    case SF_ERR_POSE_OLD: return "the pose is older than pose_timeout_ns; the service takes none so old";
    case SF_ERR_REGION: return "a region is x_min, y_min, x_max, y_max; sides positive, finite, at most 1e6 m";
    case SF_ERR_PARAM: return "there is no parameter of that name, or it cannot be set";
    case SF_ERR_BOUNDS: return "the value is not finite, not whole, or outside the parameter's bounds";
    case SF_ERR_RANGE_TIME: return "a range's time is newer than its channel's last one, at most 1 ms ahead and 1 s ago; use CLOCK_MONOTONIC";
    case SF_ERR_NOT_RUNNING: return "no live service of that name; start it: surffollow start --name ...";
    case SF_ERR_NO_PERMISSION: return "no permission; join the group of the board and the socket (ls -l /dev/shm): sf_observe needs the board, sf_attach both";
    case SF_ERR_NOT_READY: return "the service starts, is being replaced or stands still; try again";
    case SF_ERR_LAYOUT: return "the service is of another release than this header; rebuild or restart";
    case SF_ERR_BLOCK: return "the shared-memory object is damaged or not one; restart the service";
    case SF_ERR_SLOTS: return "all client slots are taken, or as many as this user or process may have (the client's detail); end a client";
    case SF_ERR_OBSERVER: return "an observer cannot send; attach with sf_attach";
    case SF_ERR_TIMEOUT: return "the service did not answer in time";
    case SF_ERR_RESTARTED: return "the service was restarted before it answered; ask again";
    case SF_ERR_BUSY: return "the last request is not answered yet; poll it first";
    case SF_ERR_TORN: return "the block changed too fast to be copied whole; try again";
    case SF_ERR_ACCESS_LOST: return "exclusive access was taken back before it ended; the copy may be mixed";
    case SF_ERR_FILE: return "the file cannot be written; the client's detail holds errno";
    case SF_ERR_MEMORY: return "not enough memory for a copy of the map";
    case SF_ERR_HELD: return "this client holds the map itself, which would wait for ever; call sf_access_end first";
    case SF_ERR_WORLD_HELD: return "a simulated robot or another client publishes the true pose; stop that one";
    case SF_ERR_OWNER: return "the service belongs to a user who is not trusted (in the client's detail); name him: sf_attach_owner, SURFFOLLOW_OWNER";
    case SF_ERR_SYSTEM: return "a system call failed; the client's detail holds errno";
    default: break;
  }
  return result < SF_REFUSED ? sf_answer_text(SF_REFUSED - result) : "unknown result";
}

