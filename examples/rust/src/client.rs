//! A client of the service, by the rules of docs/reference/protocol.md and the numbers of its JSON alone.

use crate::layout as l;
use crate::shared::{Memory, Payload};
use crate::sys;
use std::collections::HashMap;
use std::fs::{metadata, OpenOptions};
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::sync::atomic::Ordering;
use std::thread::sleep;
use std::time::Duration;

const PATIENCE_NS: i64 = 5_000_000_000;

/// The demand of the newest cycle; six zeros unless it is valid.
pub struct Demand {
    pub valid: bool,
    pub stale: bool,
    pub pose_t_ns: i64,
    pub vector: [f64; 6],
    pub range_m: f64,
}

/// *Attaching*, steps 1 to 4.
struct Board {
    path: String,
    identity: (u64, u64),
    owner: u32,
    memory: Memory,
    parts: HashMap<String, usize>,
    epoch: i64,
    period_ns: i64,
}

impl Board {
    fn open(name: &str) -> Result<Board, String> {
        let path = format!("/dev/shm/{name}");
        let flags = sys::O_NOFOLLOW | sys::O_NONBLOCK | sys::O_CLOEXEC;
        let file = OpenOptions::new().read(true).custom_flags(flags).open(&path);
        let file = file.map_err(|e| format!("no service {name}: {e}"))?;
        let found = file.metadata().map_err(|e| e.to_string())?;
        if !found.is_file() || found.len() < 4096 {
            return Err(format!("{path} is no board"));
        }
        if found.uid() != 0 && found.uid() != unsafe { sys::geteuid() } {
            return Err(format!("the board belongs to user {}, who is not trusted", found.uid()));
        }
        let memory = Memory::map(file.as_raw_fd(), found.len() as usize, false)?;
        use l::sf_board_header as h;
        let state = memory.word(h::STATE).load(Ordering::Acquire);
        if state < l::state::READY || memory.word(h::MAGIC).load(Ordering::Relaxed) as u64 != l::BOARD_MAGIC {
            return Err("the board is not ready".into());
        }
        let header = memory.fixed(0, h::BYTES);
        let version = u32::from_le_bytes(header[h::VERSION..h::VERSION + 4].try_into().expect("four"));
        let header = Payload::from_bytes(&header);
        if version != l::LAYOUT_VERSION || header.int(h::LAYOUT_HASH) as u64 != l::LAYOUT_HASH {
            return Err("the service is of another release than this program; build it again".into());
        }
        let bytes = header.bytes();
        let count = u32::from_le_bytes(bytes[h::N_REGIONS..h::N_REGIONS + 4].try_into().expect("four"));
        let mut parts = HashMap::new();
        for k in 0..count as usize {
            let at = h::REGION + k * l::sf_region::BYTES;
            let text: Vec<u8> = bytes[at..].iter().copied().take_while(|b| *b != 0).collect();
            parts.insert(String::from_utf8_lossy(&text).into(), header.int(at + l::sf_region::OFFSET) as usize);
        }
        Ok(Board {
            path,
            identity: (found.dev(), found.ino()),
            owner: found.uid(),
            memory,
            parts,
            epoch: header.int(h::EPOCH),
            period_ns: header.int(h::PERIOD_NS),
        })
    }

    fn is_current(&self) -> bool {
        metadata(&self.path).is_ok_and(|m| (m.dev(), m.ino()) == self.identity)
    }

    fn latch(&self, part: &str, index: usize, stride: usize, bytes: usize) -> Option<Payload> {
        self.memory.read(self.parts.get(part)? + index * stride, bytes)
    }
}

/// *Getting a slot*, S1 to S5; the open connection is the ownership.
struct Slot {
    connection: OwnedFd,
    memory: Memory,
    number: usize,
    claim: i64,
    counter: i64,
}

impl Slot {
    fn ask(name: &str, board: &Board, label: &str) -> Result<Slot, String> {
        let connection = connect(name, board)?;
        say(&connection, board.epoch, l::step::SLOT_ASK, None, label)?;
        let (offer, fd) = hear(&connection, l::step::SLOT_OFFER)?;
        let fd = fd.ok_or("the service sent no descriptor")?;
        let seals = unsafe { sys::fcntl(fd.as_raw_fd(), sys::F_GET_SEALS) };
        let size = std::fs::File::from(fd.try_clone().map_err(|e| e.to_string())?).metadata();
        let size = size.map_err(|e| e.to_string())?.len() as usize;
        if seals < 0 || seals & l::SLOT_SEALS != l::SLOT_SEALS || size != l::SLOT_BYTES {
            return Err("the slot is not sealed, or of another size".into());
        }
        let memory = Memory::map(fd.as_raw_fd(), size, true)?;
        drop(fd);
        say(&connection, board.epoch, l::step::SLOT_MAPPED, Some(&offer), label)?;
        hear(&connection, l::step::SLOT_GRANT)?;
        let number = offer.int(l::sf_slot_message::SLOT) as usize;
        let claim = offer.int(l::sf_slot_message::CLAIM);
        Ok(Slot { connection, memory, number, claim, counter: 0 })
    }

    /// Whether the service holds its end: it closes it when it ends or takes the slot back.
    fn is_open(&self) -> bool {
        let mut byte = 0u8;
        let flags = sys::MSG_PEEK | sys::MSG_DONTWAIT;
        let got = unsafe { sys::recv(self.connection.as_raw_fd(), (&mut byte as *mut u8).cast(), 1, flags) };
        got > 0 || (got < 0 && matches!(sys::errno(), sys::EAGAIN | sys::EINTR))
    }
}

fn connect(name: &str, board: &Board) -> Result<OwnedFd, String> {
    let mut address = sys::Address { family: sys::AF_UNIX as u16, path: [0; 108] };
    let path = format!("/dev/shm/{name}.sock");
    address.path[..path.len()].copy_from_slice(path.as_bytes());
    let fd = unsafe { sys::socket(sys::AF_UNIX, sys::SOCK_SEQPACKET | sys::O_CLOEXEC, 0) };
    if fd < 0 {
        return Err(format!("no socket: errno {}", sys::errno()));
    }
    let fd = unsafe { OwnedFd::from_raw_fd(fd) };
    let size = std::mem::size_of::<sys::Address>() as u32;
    let timeout: [i64; 2] = [l::wait::SLOT_WAIT_NS / 1_000_000_000, l::wait::SLOT_WAIT_NS % 1_000_000_000 / 1000];
    unsafe { sys::setsockopt(fd.as_raw_fd(), sys::SOL_SOCKET, sys::SO_RCVTIMEO, timeout.as_ptr().cast(), 16) };
    let end_ns = sys::now_ns() + l::wait::SLOT_WAIT_NS;
    while unsafe { sys::connect(fd.as_raw_fd(), &address, size) } != 0 {
        let number = sys::errno();
        if !matches!(number, sys::EAGAIN | sys::EINTR) || sys::now_ns() > end_ns {
            return Err(format!("nobody listens on {path}: errno {number}"));
        }
        sleep(Duration::from_nanos(l::wait::CONNECT_AGAIN_NS as u64));
    }
    let (mut peer, mut len) = ([0u32, u32::MAX, 0], 12u32); // pid, uid, gid
    let at = peer.as_mut_ptr().cast();
    unsafe { sys::getsockopt(fd.as_raw_fd(), sys::SOL_SOCKET, sys::SO_PEERCRED, at, &mut len) };
    if peer[1] != board.owner {
        return Err(format!("user {} listens on {path}, the board is user {}'s", peer[1], board.owner));
    }
    Ok(fd)
}

fn say(fd: &OwnedFd, epoch: i64, step: i64, offer: Option<&Payload>, label: &str) -> Result<(), String> {
    use l::sf_slot_message as m;
    let mut message = Payload::new(m::BYTES);
    message.set(m::MAGIC, l::SLOT_MAGIC as i64);
    message.set(m::LAYOUT_HASH, l::LAYOUT_HASH as i64);
    message.set(m::STEP, step);
    message.set(m::EPOCH, epoch);
    message.set_text(m::NAME, 32, label);
    if let Some(offer) = offer {
        message.set(m::SLOT, offer.int(m::SLOT));
        message.set(m::CLAIM, offer.int(m::CLAIM));
    }
    let bytes = message.bytes();
    let sent = unsafe { sys::send(fd.as_raw_fd(), bytes.as_ptr().cast(), bytes.len(), sys::MSG_NOSIGNAL) };
    if sent == bytes.len() as isize { Ok(()) } else { Err("the service closed the connection".into()) }
}

fn hear(fd: &OwnedFd, step: i64) -> Result<(Payload, Option<OwnedFd>), String> {
    use l::sf_slot_message as m;
    let mut bytes = vec![0u8; m::BYTES];
    let mut piece = sys::Iovec { base: bytes.as_mut_ptr().cast(), len: bytes.len() };
    let mut control = sys::Control { len: 0, level: 0, kind: 0, fd: -1, pad: 0 };
    let mut message = sys::Msghdr {
        name: std::ptr::null_mut(),
        namelen: 0,
        iov: &mut piece,
        iovlen: 1,
        control: (&mut control as *mut sys::Control).cast(),
        controllen: std::mem::size_of::<sys::Control>(),
        flags: 0,
    };
    let got = unsafe { sys::recvmsg(fd.as_raw_fd(), &mut message, sys::MSG_CMSG_CLOEXEC) };
    let sent = message.controllen > 0 && control.level == sys::SOL_SOCKET && control.kind == sys::SCM_RIGHTS;
    let memory = if sent { Some(unsafe { OwnedFd::from_raw_fd(control.fd) }) } else { None };
    let told = Payload::from_bytes(&bytes);
    if got != m::BYTES as isize || told.int(m::MAGIC) as u64 != l::SLOT_MAGIC {
        return Err("the service did not answer, or it is being replaced".into());
    }
    if told.int(m::STEP) == l::step::SLOT_REFUSE {
        return Err(format!("no slot: {}", l::refusal_text(told.int(m::RESULT))));
    }
    if told.int(m::STEP) != step {
        return Err(format!("step {} out of turn", told.int(m::STEP)));
    }
    Ok((told, memory))
}

/// An attachment that follows its service through restarts.
pub struct Client {
    name: String,
    board: Board,
    slot: Option<Slot>,
    next_look_ns: i64,
    pub attachments: u32,
}

impl Client {
    /// Attach; a service that is starting is waited for.
    pub fn attach(name: &str) -> Result<Client, String> {
        let end_ns = sys::now_ns() + PATIENCE_NS;
        loop {
            let made = Board::open(name).and_then(|board| {
                let slot = Slot::ask(name, &board, "rust")?;
                Ok(Client { name: name.into(), board, slot: Some(slot), next_look_ns: 0, attachments: 1 })
            });
            if made.is_ok() || sys::now_ns() > end_ns {
                return made;
            }
            sleep(Duration::from_millis(20));
        }
    }

    /// *Poses and demands*: valid when VALID is set and it is not stale. While stale, look for a restart.
    pub fn demand(&mut self) -> Demand {
        use l::sf_output as o;
        let output = self.board.latch("output", 0, 0, o::BYTES);
        let period_ns = self.board.period_ns;
        let most_ns = (l::wait::STALE_PERIODS * period_ns)
            .min(l::wait::STALE_MAX_NS)
            .max(l::wait::STALE_LEAST_PERIODS * period_ns)
            .max(l::wait::STALE_MIN_NS);
        let stale = output.as_ref().map_or(true, |p| sys::now_ns() - p.int(o::T_NS) > most_ns);
        if stale {
            self.follow();
        }
        let none = Demand { valid: false, stale, pose_t_ns: 0, vector: [0.0; 6], range_m: f64::NAN };
        match output {
            Some(p) if !stale => {
                let valid = p.int(o::STATUS) & l::status::VALID != 0;
                let vector = std::array::from_fn(|k| if valid { p.float(o::DEMAND + 8 * k) } else { 0.0 });
                Demand { valid, stale, pose_t_ns: p.int(o::POSE_T_NS), vector, range_m: p.float(o::RANGE_M) }
            }
            _ => none,
        }
    }

    /// *Identity, death and restart*: another board that is READY is attached to.
    fn follow(&mut self) {
        let now_ns = sys::now_ns();
        if now_ns < self.next_look_ns {
            return;
        }
        self.next_look_ns = now_ns + l::wait::REATTACH_EVERY_NS;
        if self.slot.as_ref().is_some_and(|s| !s.is_open()) {
            self.slot = None;
        }
        if self.board.is_current() && self.slot.is_some() {
            return;
        }
        let Ok(board) = Board::open(&self.name) else { return };
        if board.owner != self.board.owner {
            return;
        }
        if let Ok(slot) = Slot::ask(&self.name, &board, "rust") {
            self.board = board;
            self.slot = Some(slot);
            self.attachments += 1;
        }
    }

    /// Send the tool's pose: x y z [m] and a unit quaternion, true at `t_ns`. The pose must be claimed.
    pub fn pose(&self, t_ns: i64, pose: &[f64; 7]) {
        use l::sf_pose_post as p;
        let Some(slot) = &self.slot else { return };
        let mut post = Payload::new(p::BYTES);
        post.set(p::T_NS, t_ns);
        for (k, value) in pose.iter().enumerate() {
            post.set_float(p::POSE + 8 * k, *value);
        }
        slot.memory.write(l::SLOT_POSE, &post);
    }

    /// Send a request and wait for its answer, which bears our counter and our claim.
    pub fn request(&mut self, code: i64, values: &[f64]) -> Result<(), String> {
        use l::{sf_ack as a, sf_request_post as r};
        let slot = self.slot.as_mut().ok_or("no slot: the service has gone")?;
        slot.counter += 1;
        let mut post = Payload::new(r::BYTES);
        post.set(r::COUNTER, slot.counter);
        post.set(r::CODE, code);
        post.set(r::N, values.len() as i64);
        post.set(r::CLAIM, slot.claim);
        for (k, value) in values.iter().enumerate() {
            post.set_float(r::VALUE + 8 * k, *value);
        }
        slot.memory.write(l::SLOT_REQUEST, &post);
        let end_ns = sys::now_ns() + PATIENCE_NS;
        while sys::now_ns() < end_ns {
            let ack = self.board.latch("acks", slot.number, l::stride::ACKS, a::BYTES);
            match ack {
                Some(ack) if ack.int(a::COUNTER) == slot.counter && ack.int(a::CLAIM) == slot.claim => {
                    let result = ack.int(a::RESULT);
                    let refused = || format!("refused: {} ({})", l::answer_text(result), ack.int(a::DETAIL));
                    return if result == l::answer::OK { Ok(()) } else { Err(refused()) };
                }
                _ if !slot.is_open() => return Err("the service ended before it answered".into()),
                _ => sleep(Duration::from_micros(200)),
            }
        }
        Err("the service did not answer".into())
    }
}
