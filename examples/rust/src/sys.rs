//! System calls that the standard library lacks: the C library's, for Linux on x86-64 and aarch64.

use std::ffi::{c_int, c_void};
use std::io::Error;

#[repr(C)]
pub struct Iovec {
    pub base: *mut c_void,
    pub len: usize,
}

#[repr(C)]
pub struct Msghdr {
    pub name: *mut c_void,
    pub namelen: u32,
    pub iov: *mut Iovec,
    pub iovlen: usize,
    pub control: *mut c_void,
    pub controllen: usize,
    pub flags: c_int,
}

/// Control data with room for one descriptor.
#[repr(C, align(8))]
pub struct Control {
    pub len: usize,
    pub level: c_int,
    pub kind: c_int,
    pub fd: c_int,
    pub pad: c_int,
}

#[repr(C)]
pub struct Address {
    pub family: u16,
    pub path: [u8; 108],
}

#[repr(C)]
struct Timespec {
    s: i64,
    ns: i64,
}

extern "C" {
    pub fn mmap(at: *mut c_void, len: usize, prot: c_int, flags: c_int, fd: c_int, offset: i64) -> *mut c_void;
    pub fn munmap(at: *mut c_void, len: usize) -> c_int;
    pub fn socket(family: c_int, kind: c_int, protocol: c_int) -> c_int;
    pub fn connect(fd: c_int, address: *const Address, len: u32) -> c_int;
    pub fn send(fd: c_int, data: *const c_void, len: usize, flags: c_int) -> isize;
    pub fn recv(fd: c_int, data: *mut c_void, len: usize, flags: c_int) -> isize;
    pub fn recvmsg(fd: c_int, message: *mut Msghdr, flags: c_int) -> isize;
    pub fn getsockopt(fd: c_int, level: c_int, name: c_int, value: *mut c_void, len: *mut u32) -> c_int;
    pub fn setsockopt(fd: c_int, level: c_int, name: c_int, value: *const c_void, len: u32) -> c_int;
    pub fn fcntl(fd: c_int, command: c_int, ...) -> c_int;
    pub fn geteuid() -> u32;
    fn clock_gettime(clock: c_int, time: *mut Timespec) -> c_int;
}

pub const PROT_READ: c_int = 1;
pub const PROT_WRITE: c_int = 2;
pub const MAP_SHARED: c_int = 1;
pub const O_NONBLOCK: c_int = 0o4000;
pub const O_CLOEXEC: c_int = 0o2000000;
#[cfg(target_arch = "x86_64")]
pub const O_NOFOLLOW: c_int = 0o400000;
#[cfg(target_arch = "aarch64")]
pub const O_NOFOLLOW: c_int = 0o100000;
pub const AF_UNIX: c_int = 1;
pub const SOCK_SEQPACKET: c_int = 5;
pub const SOL_SOCKET: c_int = 1;
pub const SO_PEERCRED: c_int = 17;
pub const SO_RCVTIMEO: c_int = 20;
pub const SCM_RIGHTS: c_int = 1;
pub const MSG_PEEK: c_int = 2;
pub const MSG_DONTWAIT: c_int = 0x40;
pub const MSG_NOSIGNAL: c_int = 0x4000;
pub const MSG_CMSG_CLOEXEC: c_int = 0x40000000;
pub const F_GET_SEALS: c_int = 1034;
pub const EINTR: i32 = 4;
pub const EAGAIN: i32 = 11;

/// Now on CLOCK_MONOTONIC [ns].
pub fn now_ns() -> i64 {
    let mut t = Timespec { s: 0, ns: 0 };
    unsafe { clock_gettime(1, &mut t) };
    t.s * 1_000_000_000 + t.ns
}

pub fn errno() -> i32 {
    Error::last_os_error().raw_os_error().unwrap_or(0)
}
