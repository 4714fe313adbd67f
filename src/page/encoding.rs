//! How numbers and structs become bytes in the map, in headers and in run state: the only file that names bincode.
//!
//! A sealed value is a body with a checksum in front that is bound to the store, to the table and to the key, so that a
//! value read from the wrong place, from another store or with a flipped bit is never taken for good. The checksum
//! protects against accidents, not against forgery.
//!
//! Invariants: 1. the same value gives the same bytes on every machine: little-endian, fixed width; 2. decoding allocates
//! no more than [`DECODE_MAX_BYTES`], whatever the bytes say.

use xxhash_rust::xxh3::Xxh3;

/// Most bytes that one decoded struct may hold. Longer things are opaque tails behind the struct.
pub const DECODE_MAX_BYTES: usize = 1 << 16;

/// Bytes that a seal adds in front of a body.
pub const SEAL_BYTES: usize = 8;

/// Bytes that are not what they should be.
#[derive(Debug, Clone, thiserror::Error)]
pub enum EncodingError {
    /// The checksum does not fit body, key and store.
    #[error("checksum does not match")]
    Checksum,
    /// Too short, too long or with impossible values.
    #[error("not decodable: {0}")]
    Malformed(String),
}

fn configuration() -> impl bincode::config::Config {
    bincode::config::standard().with_fixed_int_encoding().with_limit::<DECODE_MAX_BYTES>()
}

/// The bytes of `value`. Structs of the store stay below [`DECODE_MAX_BYTES`].
///
/// # Errors
/// A value that cannot be written, such as one above the limit.
pub fn encode<T: bincode::Encode>(value: &T) -> Result<Vec<u8>, EncodingError> {
    bincode::encode_to_vec(value, configuration()).map_err(|e| EncodingError::Malformed(e.to_string()))
}

/// The value at the start of `bytes`, and what follows it.
///
/// # Errors
/// Bytes that no [`encode`] wrote.
pub fn decode<T: bincode::Decode<()>>(bytes: &[u8]) -> Result<(T, &[u8]), EncodingError> {
    let (value, used) =
        bincode::decode_from_slice(bytes, configuration()).map_err(|e| EncodingError::Malformed(e.to_string()))?;
    Ok((value, bytes.get(used..).unwrap_or(&[])))
}

/// The value that `bytes` hold and nothing else.
///
/// # Errors
/// Bytes that no [`encode`] wrote, or more than one value's.
pub fn decode_all<T: bincode::Decode<()>>(bytes: &[u8]) -> Result<T, EncodingError> {
    let (value, rest) = decode(bytes)?;
    if rest.is_empty() { Ok(value) } else { Err(EncodingError::Malformed(format!("{} bytes too many", rest.len()))) }
}

/// Whose values, and which table's: what every seal is bound to beside the key.
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

    /// `body` with its checksum in front.
    pub fn seal(self, key: &[u8], body: &[u8]) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(SEAL_BYTES + body.len());
        bytes.extend_from_slice(&self.checksum(key, body).to_le_bytes());
        bytes.extend_from_slice(body);
        bytes
    }

    /// The body of a sealed value and its checksum.
    ///
    /// # Errors
    /// A value that was not sealed under this scope and key, or was changed since.
    pub fn unseal<'a>(self, key: &[u8], sealed: &'a [u8]) -> Result<(&'a [u8], u64), EncodingError> {
        let (checksum, body) = sealed.split_first_chunk::<SEAL_BYTES>().ok_or(EncodingError::Checksum)?;
        let checksum = u64::from_le_bytes(*checksum);
        if checksum == self.checksum(key, body) { Ok((body, checksum)) } else { Err(EncodingError::Checksum) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_flipped_bit_and_every_wrong_place_is_noticed() {
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
        // The border between key and body is part of what is sealed.
        assert!(scope.unseal(b"keys", &scope.seal(b"key", b"s")).is_err());
    }

    #[test]
    fn lengths_in_hostile_bytes_allocate_nothing() {
        let mut bytes = u64::MAX.to_le_bytes().to_vec();
        bytes.extend_from_slice(&[1; 40]);
        assert!(decode_all::<Vec<u8>>(&bytes).is_err());
        assert!(decode_all::<Vec<u64>>(&(1u64 << 40).to_le_bytes()).is_err());
        let good = encode(&(3u32, 9u64)).unwrap();
        assert_eq!(decode_all::<(u32, u64)>(&good).unwrap(), (3, 9));
        assert!(decode_all::<u32>(&good).is_err());
        assert!(decode_all::<(u32, u64)>(&good[..11]).is_err());
    }
}
