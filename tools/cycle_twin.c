/* One cycle of the paper's follower and its map updates in plain C: what `make bench` holds the kernels
 * against, in time and bit for bit. Straightforward on purpose; layout.h is generated from the schemas. */

#include <math.h>
#include <stdint.h>
#include "layout.h"

enum { CHANNELS = 8, WINDOW = 64, POSES = 256, POINTS = 64, INTERVALS = 1024 };
enum { VALID = 1, NO_POSE = 2, POSE_STALE = 4, NO_SENSOR = 8, TOO_CLOSE = 16, LIMITED = 32, SENSOR_LOST = 256 };
static const double ABSENT_TAU = 0.25;

static void take_poses(SenseState *s, const Inputs *in) {
  for (int64_t k = 0; k < in->n_poses; k++) {
    int64_t n = s->pose_count;
    if (n > 0 && in->pose_t_ns[k] <= s->pose_t_ns[(n - 1) & (POSES - 1)]) {
      s->poses_refused++;
      continue;
    }
    int64_t slot = n & (POSES - 1);
    s->pose_t_ns[slot] = in->pose_t_ns[k];
    for (int i = 0; i < 7; i++) s->pose[slot * 7 + i] = in->pose[k * 7 + i];
    s->pose_count = n + 1;
  }
}

static void lose_channel(SenseState *s, int64_t c) {
  s->window_n[c] = s->valid[c] = s->fresh[c] = 0;
  s->losses[c]++;
}

static void push_sample(const Params *p, SenseState *s, int64_t c, int64_t t, double range) {
  if (s->missed[c]) {
    s->missed[c] = 0;
    int64_t gap = t - s->seen_t_ns[c];
    if (s->seen_t_ns[c] != 0 && gap > 2 * s->spacing_ns[c] && gap > ABSENT_TAU * 1e9 * p->plant_tau_s) lose_channel(s, c);
  }
  int64_t slot = c * WINDOW + (s->window_n[c] & (WINDOW - 1));
  s->window_m[slot] = range;
  s->window_t_ns[slot] = t;
  s->window_n[c]++;
  s->fresh[c] = 1;
}

static void note_spacing(SenseState *s, int64_t c, int64_t t) {
  if (s->seen_t_ns[c] != 0) {
    int64_t gap = t - s->seen_t_ns[c], usual = s->spacing_ns[c];
    if (usual == 0 || gap < usual)
      s->spacing_ns[c] = gap > 1 ? gap : 1;
    else
      s->spacing_ns[c] += (gap - usual) / 8;
  }
  s->seen_t_ns[c] = t;
}

static void take_conversions(const Params *p, SenseState *s, const Inputs *in) {
  for (int c = 0; c < CHANNELS; c++) s->fresh[c] = 0;
  for (int64_t k = 0; k < in->n_conversions; k++) {
    int64_t word = in->conversion[k];
    int64_t c = (word >> 24) & 7;
    if (c >= p->n_channels) continue;
    int64_t counts = ((word & 0xFFFFFF) ^ 0x800000) - 0x800000;
    double range = p->zero_m[c] + p->scale_m[c] * (double)counts;
    if ((word >> 27) & 1) {
      lose_channel(s, c);
    } else if (p->range_min_m < range && range < p->range_max_m) {
      push_sample(p, s, c, in->t_ns + (word >> 32), range);
    } else {
      lose_channel(s, c);
      s->outside += c == 0;
    }
  }
  int64_t readings = p->sensor_readings;
  for (int64_t c = 0; c < p->n_channels; c++) {
    if (!s->fresh[c]) {
      s->missed[c] = 1;
      continue;
    }
    int64_t n = s->window_n[c], base = c * WINDOW;
    int64_t last = s->window_t_ns[base + ((n - 1) & (WINDOW - 1))];
    note_spacing(s, c, last);
    if (n < readings) {
      s->fresh[c] = 0;
      continue;
    }
    double total = 0.0;
    for (int64_t i = n - readings; i < n; i++) total += s->window_m[base + (i & (WINDOW - 1))];
    int64_t first = s->window_t_ns[base + ((n - readings) & (WINDOW - 1))];
    s->range_m[c] = total / (double)readings;
    s->range_t_ns[c] = first + (last - first) / 2 - p->sensor_latency_ns;
    s->valid[c] = 1;
  }
}

static void rotate(const double *q, double x, double y, double z, double *out) {
  double tx = q[1] * z - q[2] * y + q[3] * x;
  double ty = q[2] * x - q[0] * z + q[3] * y;
  double tz = q[0] * y - q[1] * x + q[3] * z;
  out[0] = x + 2.0 * (q[1] * tz - q[2] * ty);
  out[1] = y + 2.0 * (q[2] * tx - q[0] * tz);
  out[2] = z + 2.0 * (q[0] * ty - q[1] * tx);
}

/* the footprint into point[3]; returns the sensor's height */
static double footprint(const double *tool, const double *mount, double range, double *point) {
  double beam[3], arm[3], way[3];
  rotate(mount + 3, 0.0, 0.0, -range, beam);
  rotate(tool + 3, mount[0], mount[1], mount[2], arm);
  rotate(tool + 3, beam[0], beam[1], beam[2], way);
  double sensor_z = tool[2] + arm[2];
  point[0] = tool[0] + arm[0] + way[0];
  point[1] = tool[1] + arm[1] + way[1];
  point[2] = sensor_z + way[2];
  return sensor_z;
}

static void average_point(const Params *p, PaperState *s, const SenseState *sense, int64_t c, int64_t pose_t,
                          double *point) {
  if (s->point_losses[c] != sense->losses[c]) {
    s->point_losses[c] = sense->losses[c];
    s->point_count[c] = 0;
    if (c == 0) s->speed_pose = s->reading_t_ns = 0;
  }
  int64_t n = s->point_count[c], base = c * POINTS * 3;
  for (int i = 0; i < 3; i++) s->point_m[base + (n & (POINTS - 1)) * 3 + i] = point[i];
  s->point_count[c] = n + 1;
  int64_t used = n + 1 < p->ee_readings ? n + 1 : p->ee_readings;
  double mean[3] = {point[0], point[1], point[2]};
  if (used > 1) {
    double sum[3] = {0.0, 0.0, 0.0};
    for (int64_t k = n + 1 - used; k < n + 1; k++)
      for (int i = 0; i < 3; i++) sum[i] += s->point_m[base + (k & (POINTS - 1)) * 3 + i];
    for (int i = 0; i < 3; i++) mean[i] = sum[i] / (double)used;
  }
  if (c == 0) {
    s->point_t_ns[n & (POINTS - 1)] = pose_t;
    for (int i = 0; i < 3; i++) s->mean_m[i] = mean[i];
  }
  double reach2 = p->interval_size_m * p->interval_size_m;
  for (int64_t k = n; k > n - used; k--) {
    const double *q = s->point_m + base + (k & (POINTS - 1)) * 3;
    double dx = mean[0] - q[0], dy = mean[1] - q[1];
    if (dx * dx + dy * dy <= reach2) {
      for (int i = 0; i < 3; i++) point[i] = mean[i];
      return;
    }
  }
}

static void open_interval(PaperState *s, double x, double y, double h) {
  int64_t slot = s->interval_count & (INTERVALS - 1);
  s->interval_x_m[slot] = x;
  s->interval_y_m[slot] = y;
  s->interval_h_m[slot] = h;
  s->interval_n[slot] = 1;
  s->interval_count++;
}

static int64_t add_point(PaperState *s, double x, double y, double h, double size) {
  if (s->interval_count == 0) {
    open_interval(s, x, y, h);
    return 1;
  }
  int64_t slot = (s->interval_count - 1) & (INTERVALS - 1), opened = 0;
  double cx = s->interval_x_m[slot], cy = s->interval_y_m[slot], ch = s->interval_h_m[slot];
  double dx = x - cx, dy = y - cy, distance = sqrt(dx * dx + dy * dy);
  if (distance > 2.0 * size) {
    double steps = distance / size;
    int64_t last = (int64_t)(steps < 1e15 ? steps : 1e15);
    int64_t first = last - INTERVALS + 1 > 1 ? last - INTERVALS + 1 : 1;
    for (int64_t k = first; k <= last; k++) {
      double part = (double)k / steps;
      open_interval(s, cx + dx * part, cy + dy * part, ch + (h - ch) * part);
    }
    opened = last - first + 1;
  } else if (distance > size) {
    open_interval(s, x, y, h);
    return 1;
  }
  slot = (s->interval_count - 1) & (INTERVALS - 1);
  int64_t n = s->interval_n[slot];
  s->interval_h_m[slot] = (s->interval_h_m[slot] * (double)n + h) / (double)(n + 1);
  s->interval_n[slot] = n + 1;
  return opened;
}

static void cut_ranges(PaperState *s, int64_t size) {
  s->range_cut = size;
  int64_t first = s->interval_count - 2 * size;
  if (first < 0) return;
  double rest = 0.0, prev = 0.0, run = 0.0;
  for (int64_t k = 0; k < 2 * size - 1; k++) {
    int64_t a = (first + k) & (INTERVALS - 1), b = (first + k + 1) & (INTERVALS - 1);
    if (k < size)
      prev += s->interval_h_m[a];
    else
      rest += s->interval_h_m[a];
    double dx = s->interval_x_m[b] - s->interval_x_m[a], dy = s->interval_y_m[b] - s->interval_y_m[a];
    int64_t pairs = k + 1 < 2 * size - 1 - k ? k + 1 : 2 * size - 1 - k;
    run += (double)pairs * sqrt(dx * dx + dy * dy);
  }
  s->rest_h_m = rest;
  s->range_prev_h_m = prev / (double)size;
  s->range_gap_m = run / (double)size;
}

static double range_slope(const PaperState *s, int64_t size) {
  if (s->interval_count < 2 * size || s->range_gap_m <= 0.0) return 0.0;
  double newest = s->interval_h_m[(s->interval_count - 1) & (INTERVALS - 1)];
  return ((s->rest_h_m + newest) / (double)size - s->range_prev_h_m) / s->range_gap_m;
}

static void measure_speed(const Params *p, PaperState *s, const SenseState *sense) {
  if (sense->pose_count == s->speed_pose) return;
  int64_t n = s->point_count[0], used = n < p->ee_readings ? n : p->ee_readings, older = 0;
  int64_t newest = s->point_t_ns[(n - 1) & (POINTS - 1)];
  for (int64_t k = n - used; k < n; k++) older += newest - s->point_t_ns[k & (POINTS - 1)];
  int64_t t = newest - older / used;
  if (s->speed_pose > 0 && t > s->speed_t_ns) {
    double dx = s->mean_m[0] - s->speed_x_m, dy = s->mean_m[1] - s->speed_y_m;
    s->speed_mps = sqrt(dx * dx + dy * dy) / ((double)(t - s->speed_t_ns) * 1e-9);
  }
  s->speed_x_m = s->mean_m[0];
  s->speed_y_m = s->mean_m[1];
  s->speed_t_ns = t;
  s->speed_pose = sense->pose_count;
}

static void watch_fold_back(FoldBackState *s, double range, double sensor_z, double near, double far) {
  if (!s->close) {
    if (range < near) {
      s->close = 1;
      s->close_z_m = sensor_z;
      s->close_range_m = range;
    }
    return;
  }
  double rise = sensor_z - s->close_z_m;
  if (fabs(rise) < 0.002) return;
  if ((range - s->close_range_m) * rise > 0.5 * rise * rise && range > far) s->close = 0;
  s->close_z_m = sensor_z;
  s->close_range_m = range;
}

static double limit(double value, double most) {
  return value > most ? most : value < -most ? -most : value == value ? value : 0.0;
}

static double relay(PaperState *s, double demand, double sensor_z, double permitted) {
  if (!s->relayed) {
    s->relayed = 1;
    s->relayed_m = 0.0;
    s->relayed_z_m = sensor_z;
  }
  double kept = s->relayed_m - (sensor_z - s->relayed_z_m);
  if (fabs(demand - kept) <= permitted) return kept;
  s->relayed_m = demand;
  s->relayed_z_m = sensor_z;
  return demand;
}

static int64_t demand_z(const Params *p, FollowState *st, const Inputs *in, Output *out, double sensor_z) {
  PaperState *s = &st->paper;
  SenseState *sense = &st->sense;
  const double *tool = sense->pose + ((sense->pose_count - 1) & (POSES - 1)) * 7;
  int64_t fresh = out->fresh & 1;
  double range = sense->range_m[0], point[3];
  if (fresh) {
    const double *m = s->mean_m;
    if (add_point(s, m[0], m[1], m[2], p->interval_size_m) > 0 || s->range_cut != p->range_size)
      cut_ranges(s, p->range_size);
    s->slope = range_slope(s, p->range_size);
    measure_speed(p, s, sense);
    watch_fold_back(&st->fold, range, sensor_z, p->too_close_m, p->too_close_exit_m);
  } else {
    sensor_z = footprint(tool, p->tool_from_sensor, 0.0, point);
  }
  double delta_h = 0.0, error = 0.0;
  int first = s->reading_t_ns == 0 || in->t_ns - s->reading_t_ns > p->loss_timeout_ns;
  if (fresh && first) {
    s->reading_t_ns = in->t_ns;
    s->reading_m = range;
    s->reading_z_m = sensor_z;
  }
  if (s->reading_t_ns != 0) {
    double since = (double)(in->t_ns - s->reading_t_ns) * 1e-9;
    delta_h = s->slope * s->speed_mps * since;
    if (!fresh) {
      double dx = tool[0] - s->reading_x_m, dy = tool[1] - s->reading_y_m;
      double ux = s->reading_x_m - s->before_x_m, uy = s->reading_y_m - s->before_y_m;
      double way = sqrt(ux * ux + uy * uy), along = way > 0.0 ? (dx * ux + dy * uy) / way : 0.0;
      int64_t pose_t = sense->pose_t_ns[(sense->pose_count - 1) & (POSES - 1)];
      double most = along + s->speed_mps * ((double)(in->t_ns - pose_t) * 1e-9) + p->interval_size_m;
      if (s->speed_mps * since > most) delta_h = s->slope * most;
    }
    error = p->offset_m - (s->reading_m + (sensor_z - s->reading_z_m));
  }
  if (fresh) {
    s->reading_t_ns = in->t_ns;
    s->reading_m = range;
    s->reading_z_m = sensor_z;
    s->reading_x_m = tool[0];
    s->reading_y_m = tool[1];
    const double *before = sense->pose_count > 1 ? sense->pose + ((sense->pose_count - 2) & (POSES - 1)) * 7 : tool;
    s->before_x_m = before[0];
    s->before_y_m = before[1];
  }
  out->delta_h_m = delta_h;
  out->error_m = error;
  int64_t status = VALID, age = in->t_ns - s->reading_t_ns;
  if (!fresh && (!sense->valid[0] || age > 10000000)) status |= NO_SENSOR;
  double wanted = delta_h + error, cut = limit(wanted, p->max_demand_m);
  if (cut != wanted) status |= LIMITED;
  double dz = limit(relay(s, cut, sensor_z, p->permitted_variance_m), p->max_demand_m);
  int lost = s->reading_t_ns == 0 || age > p->loss_timeout_ns;
  if (lost) {
    status = (status & ~(int64_t)(VALID | LIMITED)) | SENSOR_LOST;
    dz = 0.0;
  }
  if (st->fold.close) {
    double probe = p->max_demand_m < 0.001 ? p->max_demand_m : 0.001;
    status |= TOO_CLOSE;
    if (!lost && dz < probe) dz = probe;
  }
  out->demand[2] = dz;
  return status;
}

static void follow_step(const Params *p, FollowState *st, const Inputs *in, Output *out) {
  SenseState *s = &st->sense;
  take_poses(s, in);
  take_conversions(p, s, in);
  out->t_ns = in->t_ns;
  out->cycle = st->cycle;
  for (int i = 0; i < 6; i++) out->demand[i] = 0.0;
  out->fresh = 0;
  out->delta_h_m = out->error_m = 0.0;
  for (int c = 0; c < CHANNELS; c++) {
    out->range_m[c] = s->valid[c] ? s->range_m[c] : NAN;
    out->range_t_ns[c] = s->range_t_ns[c];
  }
  if (s->pose_count == 0) {
    out->pose_t_ns = 0;
    out->status = NO_POSE;
  } else {
    int64_t newest = (s->pose_count - 1) & (POSES - 1);
    out->pose_t_ns = s->pose_t_ns[newest];
    int64_t age = in->t_ns - out->pose_t_ns;
    if (age > p->pose_timeout_ns || -age > p->pose_timeout_ns) {
      out->status = POSE_STALE;
      for (int c = 0; c < CHANNELS; c++) s->losses[c]++;
    } else {
      double sensor_z = 0.0;
      for (int64_t c = 0; c < p->n_channels; c++) {
        if (!s->fresh[c]) continue;
        double *target = out->target_m + 3 * c;
        double z = footprint(s->pose + newest * 7, p->tool_from_sensor + c * 7, s->range_m[c], target);
        if (c == 0) sensor_z = z;
        average_point(p, &st->paper, s, c, out->pose_t_ns, target);
        out->fresh |= (int64_t)1 << c;
      }
      out->status = demand_z(p, st, in, out, sensor_z);
    }
  }
  out->slope = st->paper.slope;
  out->speed_mps = st->paper.speed_mps;
  int64_t count = out->intervals = st->paper.interval_count;
  if (count > 0) out->height_m = st->paper.interval_h_m[(count - 1) & (INTERVALS - 1)];
  if (out->status & VALID) st->stop_armed = 1; /* nothing is latched: params.stop_on is 0 here */
  st->cycle++;
}

/* running mean in int16, rounded without bias (no gate, map ready); 1 when a grid changed */
static int64_t update_map(MapHeader *w, GridPair *pairs, double x, double y, double z_m) {
  double fx = (x - w->x0_m) * w->inv_grid_per_m, fy = (y - w->y0_m) * w->inv_grid_per_m;
  if (!isfinite(fx) || !isfinite(fy) || !isfinite(z_m)) {
    w->invalid++;
    return 0;
  }
  if (!(0.0 <= fx && fx < (double)w->nx && 0.0 <= fy && fy < (double)w->ny)) {
    w->outside++;
    return 0;
  }
  if (!w->datum_set) {
    w->datum_m = floor(z_m * w->inv_quantum_per_m + 0.5) * w->quantum_m;
    w->datum_set = 1;
  }
  double z = (z_m - w->datum_m) * w->inv_quantum_per_m;
  int64_t ix = (int64_t)fx, iy = (int64_t)fy, i = iy * w->nx + ix;
  GridPair *pair = pairs + (i >> 1);
  int lane = i & 1;
  int64_t tile = (iy >> w->tile_shift) * w->tiles_x + (ix >> w->tile_shift);
  if (!(fabs(z) <= 32767.0)) {
    w->clipped++;
    if (pair->h[lane] != -32768) {
      pair->c[lane] = 0;
      pair->h[lane] = -32768;
      w->dirty[tile]++;
    }
    return 0;
  }
  int64_t count = pair->c[lane], n = w->dither_count++;
  if ((n & 63) == 0) {
    uint64_t h = w->dither_seed + (uint64_t)(n >> 6) * 0x9E3779B97F4A7C15u;
    h = (h ^ (h >> 30)) * 0xBF58476D1CE4E5B9u;
    h = (h ^ (h >> 27)) * 0x94D049BB133111EBu;
    w->dither_offset = (int64_t)((h ^ (h >> 31)) >> 32);
  }
  uint32_t draw = (uint32_t)w->dither_offset + (uint32_t)n * 0x9E3779B9u;
  double u = (double)draw * 0x1p-32;
  static double reciprocal[256];
  if (reciprocal[0] == 0.0)
    for (int k = 0; k < 256; k++) reciprocal[k] = 1.0 / (k + 1);
  double mean = count > 0 ? (double)pair->h[lane] : z;
  int64_t raised = (int64_t)(mean + (z - mean) * reciprocal[count] + (u + 32768.0)) - 32768;
  pair->h[lane] = (int16_t)(raised < 32767 ? raised : 32767);
  pair->c[lane] = (uint8_t)(count < 255 ? count + 1 : 255);
  w->dirty[tile]++;
  w->samples++;
  return 1;
}

int64_t run_batch(const Params *p, FollowState *st, const Inputs *in, Output *out, double *scratch,
                  MapHeader *header, GridPair *pairs, int64_t cycles) {
  int64_t changed = 0;
  (void)scratch;
  for (int64_t k = 0; k < cycles; k++) {
    follow_step(p, st, in + k, out);
    for (int c = 0; c < CHANNELS; c++)
      if ((out->fresh >> c) & 1)
        changed += update_map(header, pairs, out->target_m[3 * c], out->target_m[3 * c + 1],
                              out->target_m[3 * c + 2]);
  }
  return changed;
}
