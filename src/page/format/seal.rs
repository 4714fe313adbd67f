//! Checksums bound to the place of the value they protect.
//!
//! A sealed value is a body preceded by a checksum that also covers the store's identity, the table and the key. So a
//! value from the wrong place, from another store or with a flipped bit is always recognised. Seals protect against
//! accidents, not against forgery.

use xxhash_rust::xxh3::Xxh3;

/// Bytes that a seal adds before the body.
pub const SEAL_BYTES: usize = 8;

/// The value was not sealed under this scope and key, or has changed since.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("its checksum does not match")]
pub struct SealBroken;

/// The store and table that a seal is bound to, beside the key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SealScope {
    /// Identity of the store.
    pub store: u128,
    /// Number of the table.
    pub table: u8,
}

impl SealScope {
    /// Checksum of `body` under `key`.
    pub fn checksum(self, key: &[u8], body: &[u8]) -> u64 {
        let mut hash = Xxh3::with_seed(u64::from(self.table));
        hash.update(&self.store.to_le_bytes());
        hash.update(&(key.len() as u64).to_le_bytes());
        hash.update(key);
        hash.update(body);
        hash.digest()
    }

    /// `body` preceded by its checksum.
    pub fn seal(self, key: &[u8], body: &[u8]) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(SEAL_BYTES + body.len());
        bytes.extend_from_slice(&self.checksum(key, body).to_le_bytes());
        bytes.extend_from_slice(body);
        bytes
    }

    /// The body of a sealed value, and its checksum.
    ///
    /// # Errors
    /// The value was not sealed under this scope and key, or has changed since.
    pub fn unseal<'a>(self, key: &[u8], sealed: &'a [u8]) -> Result<(&'a [u8], u64), SealBroken> {
        let (checksum, body) = sealed.split_first_chunk::<SEAL_BYTES>().ok_or(SealBroken)?;
        let checksum = u64::from_le_bytes(*checksum);
        if checksum == self.checksum(key, body) { Ok((body, checksum)) } else { Err(SealBroken) }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test
mod tests {
    use super::*;

    #[test]
    fn every_flipped_bit_and_every_wrong_place_is_detected() {
        let scope = SealScope { store: 7, table: 1 };
        let sealed = scope.seal(b"key", b"some body");
        assert_eq!(scope.unseal(b"key", &sealed).unwrap().0, b"some body");
        for bit in 0..sealed.len() * 8 {
            let mut damaged = sealed.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            assert!(scope.unseal(b"key", &damaged).is_err(), "bit {bit}");
        }
        for cut in 0..sealed.len() {
            assert!(scope.unseal(b"key", &sealed[..cut]).is_err(), "cut at {cut}");
        }
        assert!(scope.unseal(b"kez", &sealed).is_err());
        assert!(SealScope { store: 8, table: 1 }.unseal(b"key", &sealed).is_err());
        assert!(SealScope { store: 7, table: 2 }.unseal(b"key", &sealed).is_err());
        // The border between key and body is sealed as well.
        assert!(scope.unseal(b"keys", &scope.seal(b"key", b"s")).is_err());
    }
}
