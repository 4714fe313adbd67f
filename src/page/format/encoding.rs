//! Small structs as bytes, for the index and the run state. The only file that knows the serialisation library.
//!
//! Invariants: 1. numbers are little-endian and of fixed length, so that equal values have equal bytes in every version
//! of the program; 2. decoding untrusted bytes allocates no more than their length allows, and must consume all of
//! them. Types with lists of zero-sized elements (`Vec<()>`) are not allowed: the length of such a list cannot be
//! checked.

use serde::Serialize;
use serde::de::DeserializeOwned;

/// The bytes are not a value of the type, or the value cannot be encoded.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("the value cannot be encoded or decoded: {0}")]
pub struct EncodingError(String);

/// Longest value, bytes: the state of a run with more photos than any is known to have.
pub const VALUE_BYTES_MAX: usize = 2 << 30;

/// Encodes a value.
/// Errors: the type contains something that cannot be encoded, such as a list of unknown length, or the value is too
/// long to be decoded again.
pub fn to_bytes<T: Serialize>(value: &T) -> Result<Vec<u8>, EncodingError> {
    let bytes = bincode::serde::encode_to_vec(value, bincode::config::legacy());
    let bytes = bytes.map_err(|e| EncodingError(e.to_string()))?;
    match bytes.len() {
        0..=VALUE_BYTES_MAX => Ok(bytes),
        length => Err(EncodingError(format!("{length} bytes are more than the {VALUE_BYTES_MAX} that can be decoded"))),
    }
}

/// Decodes the bytes of [`to_bytes`].
/// Errors: the bytes are not exactly one value of the type.
pub fn from_bytes<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, EncodingError> {
    // The decoder trusts lengths inside the bytes up to a limit that is a compile-time constant: take the smallest of
    // these limits that holds the bytes.
    match bytes.len() {
        0..=0x100 => from_limited::<T, 0x100>(bytes),
        0x101..=0x1000 => from_limited::<T, 0x1000>(bytes),
        0x1001..=0x1_0000 => from_limited::<T, 0x1_0000>(bytes),
        0x1_0001..=0x10_0000 => from_limited::<T, 0x10_0000>(bytes),
        0x10_0001..=0x100_0000 => from_limited::<T, 0x100_0000>(bytes),
        0x100_0001..=0x1000_0000 => from_limited::<T, 0x1000_0000>(bytes),
        _ => from_limited::<T, VALUE_BYTES_MAX>(bytes),
    }
}

fn from_limited<T: DeserializeOwned, const LIMIT: usize>(bytes: &[u8]) -> Result<T, EncodingError> {
    let config = bincode::config::legacy().with_limit::<LIMIT>();
    let (value, used) = bincode::serde::decode_from_slice(bytes, config).map_err(|e| EncodingError(e.to_string()))?;
    if used < bytes.len() {
        return Err(EncodingError(format!("{} bytes are left over", bytes.len() - used)));
    }
    Ok(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, PartialEq, Serialize, serde::Deserialize)]
    struct Sample {
        step: u32,
        scales: Vec<f32>,
        name: String,
        last: Option<u64>,
    }

    fn sample() -> Sample {
        Sample { step: 7, scales: vec![1.5, -0.0], name: "crème".to_string(), last: Some(u64::MAX) }
    }

    #[test]
    fn values_round_trip_and_their_encoding_is_fixed() {
        let bytes = to_bytes(&sample()).unwrap();
        assert_eq!(from_bytes::<Sample>(&bytes).unwrap(), sample());
        // Fixed lengths: 4, then 8 + 2 x 4, then 8 + 6, then 1 + 8.
        assert_eq!(bytes.len(), 4 + 16 + 14 + 9);
        assert_eq!(bytes[..12], [7, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0]);
        // Left-over bytes, and lengths of a list and of a string that exceed the bytes.
        let longer = [bytes.as_slice(), &[0]].concat();
        assert!(from_bytes::<Sample>(&longer).unwrap_err().to_string().contains("1 bytes are left over"));
        for at in [4, 20] {
            let mut huge = bytes.clone();
            huge[at..at + 8].fill(0x7f);
            assert!(from_bytes::<Sample>(&huge).is_err());
        }
    }
}
