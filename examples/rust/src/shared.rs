//! Mapped memory and the latches in it (docs/reference/protocol.md, "Latches").

use crate::layout as l;
use crate::sys;
use std::sync::atomic::{fence, AtomicI64, Ordering};

/// A mapping that goes with its owner.
pub struct Memory {
    at: *mut u8,
    len: usize,
}

impl Memory {
    pub fn map(fd: i32, len: usize, writable: bool) -> Result<Memory, String> {
        let prot = sys::PROT_READ | if writable { sys::PROT_WRITE } else { 0 };
        let at = unsafe { sys::mmap(std::ptr::null_mut(), len, prot, sys::MAP_SHARED, fd, 0) };
        if at as isize == -1 {
            return Err(format!("cannot map shared memory: errno {}", sys::errno()));
        }
        Ok(Memory { at: at.cast(), len })
    }

    /// One aligned word; other processes may write it at any time.
    pub fn word(&self, at: usize) -> &AtomicI64 {
        assert!(at % 8 == 0 && at + 8 <= self.len, "word at {at} of {} bytes", self.len);
        unsafe { &*self.at.add(at).cast::<AtomicI64>() }
    }

    /// Bytes that do not change any more: the board's header once it is READY.
    pub fn fixed(&self, at: usize, len: usize) -> Vec<u8> {
        (0..len)
            .map(|k| {
                let word = self.word((at + k) & !7).load(Ordering::Relaxed);
                word.to_le_bytes()[(at + k) & 7]
            })
            .collect()
    }

    /// R1 to R4: the newest payload of a latch, or None: nothing published, or overtaken too often.
    pub fn read(&self, at: usize, bytes: usize) -> Option<Payload> {
        for _ in 0..l::LATCH_MAX_TRIES {
            let g = self.word(at).load(Ordering::Acquire); // R1
            if g == 0 {
                return None;
            }
            let from = at + copy_at(g, bytes);
            let words = (0..bytes / 8).map(|k| self.word(from + 8 * k).load(Ordering::Relaxed)); // R2
            let payload = Payload { words: words.collect() };
            fence(Ordering::Acquire); // R3
            let grown = self.word(at).load(Ordering::Relaxed).wrapping_sub(g) as u64; // R4
            if grown <= l::LATCH_WHOLE_WHILE_GROWN_BY {
                return Some(payload);
            }
        }
        None
    }

    /// W1 to W3; the generation goes on from the one that lies there.
    pub fn write(&self, at: usize, payload: &Payload) {
        let g = self.word(at).load(Ordering::Relaxed).wrapping_add(1);
        let to = at + copy_at(g, 8 * payload.words.len());
        fence(Ordering::Release); // W1
        for (k, word) in payload.words.iter().enumerate() {
            self.word(to + 8 * k).store(*word, Ordering::Relaxed); // W2
        }
        self.word(at).store(g, Ordering::Release); // W3
    }
}

impl Drop for Memory {
    fn drop(&mut self) {
        unsafe { sys::munmap(self.at.cast(), self.len) };
    }
}

fn copy_at(generation: i64, bytes: usize) -> usize {
    let copy = (generation & (l::LATCH_COPIES - 1)) as usize;
    l::LATCH_COPIES_AT as usize + copy * ((bytes + 63) & !63)
}

/// A private copy of a structure; fields by their offsets.
pub struct Payload {
    words: Vec<i64>,
}

impl Payload {
    pub fn new(bytes: usize) -> Payload {
        Payload { words: vec![0; bytes / 8] }
    }

    pub fn int(&self, at: usize) -> i64 {
        self.words[at / 8]
    }

    pub fn float(&self, at: usize) -> f64 {
        f64::from_bits(self.words[at / 8] as u64)
    }

    pub fn set(&mut self, at: usize, value: i64) {
        self.words[at / 8] = value;
    }

    pub fn set_float(&mut self, at: usize, value: f64) {
        self.words[at / 8] = value.to_bits() as i64;
    }

    pub fn set_text(&mut self, at: usize, room: usize, text: &str) {
        let mut bytes = vec![0u8; room];
        let n = text.len().min(room - 1);
        bytes[..n].copy_from_slice(&text.as_bytes()[..n]);
        for (k, eight) in bytes.chunks(8).enumerate() {
            self.words[at / 8 + k] = i64::from_le_bytes(eight.try_into().expect("room is whole words"));
        }
    }

    pub fn bytes(&self) -> Vec<u8> {
        self.words.iter().flat_map(|w| w.to_le_bytes()).collect()
    }

    pub fn from_bytes(bytes: &[u8]) -> Payload {
        let words = bytes.chunks_exact(8).map(|b| i64::from_le_bytes(b.try_into().expect("eight")));
        Payload { words: words.collect() }
    }
}
