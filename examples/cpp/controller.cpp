// A robot controller in C++17: attachment as a value, a thin wrapper over surffollow.h, the same loop as
// examples/c/controller.c with a map of the way made at its end.
//
//     surffollow start &
//     surffollow status --wait 600    # until it is READY
//     c++ -std=c++17 -O2 $(surffollow print-header --cflags) -o controller controller.cpp
//     ./controller surf 20 map.txt
#include "surffollow.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <csignal>
#include <cstdlib>
#include <deque>
#include <exception>
#include <fstream>
#include <iostream>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>

namespace {

volatile std::sig_atomic_t stop = 0;

class Error : public std::runtime_error {
 public:
  explicit Error(int result) : std::runtime_error(sf_strerror(result)) {}
};

// Owns one attachment.
class Robot {
 public:
  explicit Robot(const std::string &name) { check(sf_attach(&client_, name.c_str())); }
  // an exception that ends the program is a loss of the pose, for which the service may be configured to stop
  ~Robot() { std::uncaught_exceptions() > 0 ? sf_forget(&client_) : sf_detach(&client_); }
  Robot(const Robot &) = delete;
  Robot &operator=(const Robot &) = delete;

  void reset(double standoff_m) { check(sf_sf_reset(&client_, standoff_m)); }
  void claim_pose() { check(sf_claim_pose(&client_)); }
  void set(const char *name, double value) { check(sf_set_param(&client_, name, value)); }
  double get(const char *name) {
    double value = 0.0;
    check(sf_get_param(&client_, name, &value));
    return value;
  }
  void map_reset(const std::array<double, 4> &region) { check(sf_map_reset(&client_, region.data())); }
  void upload_map(const std::string &path) { check(sf_upload_map(&client_, path.c_str())); }

  // in the control loop: no exceptions
  bool ee_pos(const std::array<double, 7> &pose, std::int64_t t_ns) noexcept {
    return sf_ee_pos(&client_, pose.data(), t_ns) == SF_OK;
  }
  std::optional<sf_demand> demand() noexcept {
    sf_demand d;
    const bool valid = sf_dev_vector(&client_, &d) == SF_OK;
    status_ = d.status;
    return valid ? std::optional<sf_demand>(d) : std::nullopt;
  }
  // the names of the status bits that the newest demand had
  std::string status() const {
    std::string names;
    for (std::int64_t bit = 1; bit <= SF_STALE; bit *= 2)
      if (status_ & bit) names += std::string(names.empty() ? "" : " ") + sf_status_name(bit);
    return names;
  }
  std::optional<double> distance(int channel = 0) noexcept {
    double range_m = 0.0;
    if (sf_raw_distance(&client_, channel, &range_m) != SF_OK) return std::nullopt;
    return range_m;
  }
  std::optional<double> map_height(double x_m, double y_m) noexcept {
    double height_m = 0.0;
    if (sf_map_height(&client_, x_m, y_m, &height_m) != SF_OK) return std::nullopt;
    return height_m;
  }

 private:
  static void check(int result) {
    if (result != SF_OK) throw Error(result);
  }
  sf_client client_;
  std::int64_t status_ = 0;
};

constexpr std::int64_t tick_ns = 10'000'000;
constexpr double standoff_m = 0.1, path_speed_mps = 0.05;
constexpr double path_accel_mps2 = 0.2; // at rest 0.25 s after the tick that missed the demand
// a circle between the boxes of the default simulated ground
constexpr double centre_x_m = 0.937, centre_y_m = 0.6, radius_m = 0.08;
// the path begins when the demand was that small for so many ticks
constexpr double settled_m = 0.5e-3;
constexpr int settled_ticks = 30;

// The stand-in: an axis that moves at most 0.2 m/s.
struct Arm {
  double x_m = centre_x_m + radius_m, y_m = centre_y_m, z_m = standoff_m;
  std::array<double, 7> read_pose() const { return {x_m, y_m, z_m, 0.0, 0.0, 0.0, 1.0}; }
  void move_to(double path_m, double set_point_m) {
    const double most = 0.2 * static_cast<double>(tick_ns) * 1e-9;
    z_m += std::clamp(set_point_m - z_m, -most, most);
    x_m = centre_x_m + radius_m * std::cos(path_m / radius_m);
    y_m = centre_y_m + radius_m * std::sin(path_m / radius_m);
  }
};

int run(const std::string &name, double seconds, const std::string &map_path, const std::string &trace_path) {
  Robot robot(name);
  robot.claim_pose(); // who sends the pose may set parameters
  robot.reset(standoff_m);
  robot.set("max_demand", 0.02);
  robot.map_reset({centre_x_m - 0.1, centre_y_m - 0.1, centre_x_m + 0.1, centre_y_m + 0.1});
  std::ofstream trace;
  if (!trace_path.empty()) trace.open(trace_path);
  trace << "t_s,x_m,y_m,z_m,range_m,demand_m\n";

  std::deque<std::pair<std::int64_t, double>> sent; // stamps and heights: demands refer to them
  Arm arm;
  double set_point_m = standoff_m, path_m = 0.0, speed_mps = 0.0, sum_sq_m2 = 0.0;
  int settled = 0;
  bool following = false;
  std::int64_t valid = 0, refused = 0, readings = 0;
  const std::int64_t start = sf_now_ns();
  const auto ticks = static_cast<std::int64_t>(seconds * 1e9) / tick_ns;
  for (std::int64_t k = 0; k < ticks && stop == 0; ++k) {
    const std::int64_t now = sf_now_ns();
    const auto pose = arm.read_pose();
    const bool posed = robot.ee_pos(pose, now);  // when not, whatever the reason, nothing is followed in this tick
    if (!posed) ++refused;
    sent.emplace_back(now, pose[2]);
    if (sent.size() > 64) sent.pop_front();
    // without a valid demand (stale, in doubt, the stop is latched): hold the height and brake along the path, as
    // docs/reference/protocol.md says under "Stop"
    if (following) set_point_m = pose[2];
    following = false;
    const auto d = robot.demand();
    if (posed && d) {
      for (const auto &[t_ns, height_m] : sent)
        if (t_ns == d->pose_t_ns) {
          set_point_m = height_m + d->demand[2];
          following = true;
        }
      ++valid;
      if (std::fabs(d->demand[2]) < settled_m) ++settled;
    }
    const double tick_s = static_cast<double>(tick_ns) * 1e-9;
    const double wanted = following && settled >= settled_ticks ? path_accel_mps2 : -path_accel_mps2;
    speed_mps = std::clamp(speed_mps + wanted * tick_s, 0.0, path_speed_mps);
    path_m += speed_mps * tick_s;
    if (following && speed_mps > 0.0) {
      const auto range_m = robot.distance();
      if (range_m) {
        sum_sq_m2 += (*range_m - standoff_m) * (*range_m - standoff_m);
        ++readings;
      }
      trace << static_cast<double>(now - start) * 1e-9 << ',' << pose[0] << ',' << pose[1] << ',' << pose[2] << ','
            << range_m.value_or(-1.0) << ',' << d->demand[2] << '\n';
    }
    arm.move_to(path_m, set_point_m);
    sf_sleep_until_ns(start + (k + 1) * tick_ns);
  }
  if (!map_path.empty()) robot.upload_map(map_path);
  std::cout << "valid " << valid << " refused " << refused << " distance_m " << robot.distance().value_or(-1.0)
            << " max_demand_m " << robot.get("max_demand_m") << " map_height_m "
            << robot.map_height(centre_x_m + radius_m, centre_y_m).value_or(-1e9) << " readings " << readings
            << " standoff_rms_mm "
            << (readings > 0 ? 1e3 * std::sqrt(sum_sq_m2 / static_cast<double>(readings)) : -1.0) << std::endl;
  if (valid > 0) return 0;
  std::cerr << "controller: no demand was valid: " << robot.status() << "; surffollow status --name " << name
            << " says more\n";
  return 1;
}

// A positive time, or nothing.
std::optional<double> read_seconds(const char *text) {
  char *end = nullptr;
  const double seconds = std::strtod(text, &end);
  if (end == text || *end != '\0' || !(seconds > 0.0 && seconds <= 1e6)) return std::nullopt;
  return seconds;
}

} // namespace

int main(int argc, char **argv) {
  std::signal(SIGINT, [](int) { stop = 1; });
  const std::string name = argc > 1 ? argv[1] : "surf";
  const bool help = name == "--help" || name == "-h";
  const auto seconds = argc > 2 ? read_seconds(argv[2]) : 20.0;
  if (help || name[0] == '-' || argc > 5 || !seconds) {
    (help ? std::cout : std::cerr) << "usage: " << argv[0] << " [service [seconds [map file [trace.csv]]]]; "
                                      "seconds: more than 0, at most 1e6\n";
    return help ? 0 : 2;
  }
  try {
    return run(name, *seconds, argc > 3 ? argv[3] : "", argc > 4 ? argv[4] : "");
  } catch (const Error &e) {
    std::cerr << "controller: " << e.what() << '\n';
    return 1;
  }
}
