//! Writes layout.rs from the JSON of `surffollow print-header --json`: by generate.py, for Rust's library reads no JSON.

use std::{env, path::Path, process::Command};

fn main() {
    let out = Path::new(&env::var("OUT_DIR").expect("cargo sets it")).join("layout.rs");
    let python = env::var("PYTHON").unwrap_or_else(|_| "python3".into());
    let done = Command::new(python).arg("generate.py").arg(&out).status();
    match done {
        Ok(status) if status.success() => {}
        other => panic!("generate.py failed ({other:?}); is surffollow installed? (PYTHON, SURFFOLLOW_LAYOUT)"),
    }
    println!("cargo:rerun-if-changed=generate.py");
    println!("cargo:rerun-if-env-changed=SURFFOLLOW_LAYOUT");
    println!("cargo:rerun-if-env-changed=PYTHON");
}
