// A robot controller in C++17: attachment as a value, a thin wrapper over surffollow.h, the same loop as
// examples/c/controller.c with a map of the way made at its end.
//
//     c++ -std=c++17 -O2 $(surffollow header --cflags) -o controller controller.cpp
//     ./controller surf 10 map.txt
#include "surffollow.h"

#include <algorithm>
#include <array>
#include <csignal>
#include <cstdlib>
#include <deque>
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
  ~Robot() { sf_detach(&client_); }
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
    if (sf_dev_vector(&client_, &d) != SF_OK) return std::nullopt;
    return d;
  }
  std::optional<double> distance(int channel = 0) noexcept {
    double range_m;
    if (sf_raw_distance(&client_, channel, &range_m) != SF_OK) return std::nullopt;
    return range_m;
  }
  std::optional<double> map_height(double x_m, double y_m) noexcept {
    double height_m;
    if (sf_map_height(&client_, x_m, y_m, &height_m) != SF_OK) return std::nullopt;
    return height_m;
  }

 private:
  static void check(int result) {
    if (result != SF_OK) throw Error(result);
  }
  sf_client client_;
};

constexpr std::int64_t tick_ns = 10'000'000;
constexpr double path_speed_mps = 0.05;
constexpr double path_accel_mps2 = 0.2; // at rest 0.25 s after the tick that missed the demand

int run(const std::string &name, double seconds, const std::string &map_path) {
  Robot robot(name);
  robot.claim_pose(); // who sends the pose may set parameters
  robot.reset(0.1);
  robot.set("max_demand", 0.02);
  robot.map_reset({-0.05, -0.05, 0.05 + path_speed_mps * seconds, 0.05});

  std::deque<std::pair<std::int64_t, double>> sent; // stamps and heights: demands refer to them
  double x_m = 0.0, z_m = 0.1, set_point_m = 0.1, speed_mps = 0.0;
  bool following = false;
  std::int64_t valid = 0, refused = 0;
  const std::int64_t start = sf_now_ns();
  const auto ticks = static_cast<std::int64_t>(seconds * 1e9) / tick_ns;
  for (std::int64_t k = 0; k < ticks && stop == 0; ++k) {
    const std::int64_t now = sf_now_ns();
    if (!robot.ee_pos({x_m, 0.0, z_m, 0.0, 0.0, 0.0, 1.0}, now)) ++refused;
    sent.emplace_back(now, z_m);
    if (sent.size() > 64) sent.pop_front();
    // without a valid demand (stale, in doubt, the stop is latched): hold the height and brake along the path, as
    // docs/protocol.md says under "Stop"
    if (following) set_point_m = z_m;
    following = false;
    if (const auto d = robot.demand()) {
      for (const auto &[t_ns, height_m] : sent)
        if (t_ns == d->pose_t_ns) {
          set_point_m = height_m + d->demand[2];
          following = true;
        }
      ++valid;
    }
    const double most = 0.2 * static_cast<double>(tick_ns) * 1e-9; // the stand-in arm: 0.2 m/s
    const double step = set_point_m - z_m;
    z_m += step > most ? most : step < -most ? -most : step;
    const double tick_s = static_cast<double>(tick_ns) * 1e-9;
    speed_mps = std::clamp(speed_mps + (following ? path_accel_mps2 : -path_accel_mps2) * tick_s, 0.0, path_speed_mps);
    x_m += speed_mps * tick_s;
    sf_sleep_until_ns(start + (k + 1) * tick_ns);
  }
  if (!map_path.empty()) robot.upload_map(map_path);
  std::cout << "valid " << valid << " refused " << refused << " distance_m " << robot.distance().value_or(-1.0)
            << " max_demand_m " << robot.get("max_demand_m") << " map_height_m "
            << robot.map_height(0.0, 0.0).value_or(-1e9) << std::endl;
  return 0;
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
  const auto seconds = argc > 2 ? read_seconds(argv[2]) : 10.0;
  if (argc > 4 || !seconds) {
    std::cerr << "usage: " << argv[0] << " [service [seconds [map file]]]; seconds: more than 0, at most 1e6\n";
    return 2;
  }
  try {
    return run(argc > 1 ? argv[1] : "surf", *seconds, argc > 3 ? argv[3] : "");
  } catch (const Error &e) {
    std::cerr << "controller: " << e.what() << '\n';
    return 1;
  }
}
