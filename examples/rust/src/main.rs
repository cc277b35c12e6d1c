//! A robot controller in Rust: a path over the ground at 100 Hz, whose height follows the service's demands.
//!
//!     surffollow start &
//!     surffollow status --wait 600    # until it is READY
//!     cargo run --release -- surf 20
//!
//! Nothing but Rust's own library: the layout comes from `surffollow print-header --json` (build.rs, generate.py), the
//! rules from docs/reference/protocol.md. The arm is the stand-in of examples/python/controller.py; a service that is killed
//! and started again is attached to again.

mod client;
mod shared;
mod sys;
mod layout {
    #![allow(dead_code)]
    include!(concat!(env!("OUT_DIR"), "/layout.rs"));
}

use client::Client;
use std::collections::VecDeque;
use std::thread::sleep;
use std::time::Duration;

const TICK_NS: i64 = 10_000_000;
const STANDOFF_M: f64 = 0.1;
const SPEED_MPS: f64 = 0.05;
const ACCEL_MPS2: f64 = 0.2;
const CENTRE_M: (f64, f64) = (0.937, 0.6);
const RADIUS_M: f64 = 0.08;
const SETTLED_M: f64 = 0.5e-3;
const SETTLED_TICKS: u32 = 30;

/// The stand-in: an axis that moves at most 0.2 m/s.
struct Arm {
    x_m: f64,
    y_m: f64,
    z_m: f64,
}

impl Arm {
    fn pose(&self) -> [f64; 7] {
        [self.x_m, self.y_m, self.z_m, 0.0, 0.0, 0.0, 1.0]
    }

    fn move_to(&mut self, path_m: f64, z_m: f64) {
        let most = 0.2 * TICK_NS as f64 * 1e-9;
        self.z_m += (z_m - self.z_m).clamp(-most, most);
        self.x_m = CENTRE_M.0 + RADIUS_M * (path_m / RADIUS_M).cos();
        self.y_m = CENTRE_M.1 + RADIUS_M * (path_m / RADIUS_M).sin();
    }
}

fn take_over(robot: &mut Client) -> Result<(), String> {
    robot.request(layout::request::CLAIM_POSE, &[])?; // who sends the pose may set parameters
    robot.request(layout::request::SF_RESET, &[STANDOFF_M])
}

fn run(name: &str, seconds: f64) -> Result<(), String> {
    let mut robot = Client::attach(name)?;
    println!("attached to {name}, built for surffollow {}", layout::RELEASE);
    take_over(&mut robot)?;
    let mut arm = Arm { x_m: CENTRE_M.0 + RADIUS_M, y_m: CENTRE_M.1, z_m: STANDOFF_M };
    let mut sent: VecDeque<(i64, f64)> = VecDeque::new(); // height of the tool by the time of its report
    let (mut set_point_m, mut path_m, mut speed_mps) = (arm.z_m, 0.0, 0.0f64);
    let (mut settled, mut following, mut attachments) = (0, false, robot.attachments);
    let (mut errors, mut readings, mut ticks, mut stale) = (0.0, 0u32, 0u32, 0u32);
    let mut next_ns = sys::now_ns();
    let end_ns = next_ns + (seconds * 1e9) as i64;
    while next_ns < end_ns {
        let t_ns = sys::now_ns();
        sent.push_back((t_ns, arm.z_m));
        robot.pose(t_ns, &arm.pose());
        let demand = robot.demand();
        if robot.attachments != attachments && take_over(&mut robot).is_ok() {
            attachments = robot.attachments; // a service that was started anew has forgotten the stand-off
            settled = 0;
        }
        stale += u32::from(demand.stale);
        // without a valid demand (stale, in doubt, stopped): hold the height, brake along the path
        if following {
            set_point_m = arm.z_m;
        }
        let named = sent.iter().find(|(t, _)| *t == demand.pose_t_ns);
        following = demand.valid && named.is_some();
        if let (true, Some((_, z_m))) = (demand.valid, named) {
            set_point_m = z_m + demand.vector[2]; // it adds to the pose that it names, not to a newer one
            settled += u32::from(demand.vector[2].abs() < SETTLED_M);
        }
        let wanted = if following && settled >= SETTLED_TICKS { ACCEL_MPS2 } else { -ACCEL_MPS2 };
        speed_mps = (speed_mps + wanted * TICK_NS as f64 * 1e-9).clamp(0.0, SPEED_MPS);
        path_m += speed_mps * TICK_NS as f64 * 1e-9;
        if following && speed_mps > 0.0 {
            ticks += 1;
            if demand.range_m.is_finite() {
                readings += 1;
                errors += (demand.range_m - STANDOFF_M).powi(2);
            }
        }
        arm.move_to(path_m, set_point_m);
        if sent.len() > 64 {
            sent.pop_front();
        }
        next_ns += TICK_NS;
        sleep(Duration::from_nanos((next_ns - sys::now_ns()).max(0) as u64));
    }
    let _ = robot.request(layout::request::RELEASE_POSE, &[]); // a normal end is no loss of the pose
    let rms_mm = if readings > 0 { 1e3 * (errors / f64::from(readings)).sqrt() } else { f64::NAN };
    println!(
        "ticks {ticks} readings {readings} standoff_rms_mm {rms_mm:.3} attachments {} stale {stale}",
        robot.attachments
    );
    Ok(())
}

fn main() {
    let words: Vec<String> = std::env::args().collect();
    let name = words.get(1).map_or("surf", String::as_str);
    let seconds = words.get(2).map_or(Ok(20.0), |w| w.parse::<f64>());
    let done = match seconds {
        Ok(s) if s > 0.0 && s <= 1e6 => run(name, s),
        _ => Err("seconds: more than 0, at most 1e6".into()),
    };
    if let Err(text) = done {
        eprintln!("controller: {text}");
        std::process::exit(1);
    }
}
