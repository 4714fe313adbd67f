//! Values of photos as a commit holds them: bytes by the name of their kind. So a new kind changes no layout, and a state without
//! it is one whose values start.
//!
//! Invariant: equal values have equal bytes.

use crate::page::format::encoding::{self, EncodingError};
use serde::de::{DeserializeOwned, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::collections::BTreeMap;

/// By name of the kind.
pub type SavedValues = BTreeMap<String, Encoded>;

/// Values of one kind.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Encoded(Vec<u8>);

/// Why bytes are not values of a kind.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ValuesError {
    /// The encoding is invalid.
    #[error(transparent)]
    Encoding(#[from] EncodingError),
    /// No run can have written them.
    #[error("{0}")]
    Impossible(&'static str),
}

impl Encoded {
    /// Encodes values.
    ///
    /// # Errors
    /// The type contains something that cannot be encoded.
    pub fn of<T: Serialize>(values: &T) -> Result<Encoded, EncodingError> {
        encoding::to_bytes(values).map(Encoded)
    }

    /// Decodes values, and checks them.
    ///
    /// # Errors
    /// The bytes are no such values, or `check` refuses them.
    pub fn decoded<T: DeserializeOwned>(
        &self,
        check: impl Fn(&T) -> Result<(), &'static str>,
    ) -> Result<T, ValuesError> {
        let values = encoding::from_bytes(&self.0)?;
        check(&values).map_err(ValuesError::Impossible)?;
        Ok(values)
    }

    /// As [`Encoded::decoded`], in place of `values`, unless they are of another number of photos.
    ///
    /// # Errors
    /// As [`Encoded::decoded`].
    pub fn restore<T: DeserializeOwned>(
        &self,
        values: &mut T,
        check: impl Fn(&T) -> Result<(), &'static str>,
        has_same_counts: impl Fn(&T, &T) -> bool,
    ) -> Result<(), ValuesError> {
        let saved = self.decoded(check)?;
        if has_same_counts(&saved, values) {
            *values = saved;
        }
        Ok(())
    }
}

/// As one run of bytes: a list would be written byte by byte.
impl Serialize for Encoded {
    fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        s.serialize_bytes(&self.0)
    }
}

impl<'de> Deserialize<'de> for Encoded {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Encoded, D::Error> {
        struct Bytes;
        impl Visitor<'_> for Bytes {
            type Value = Encoded;

            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("bytes")
            }

            fn visit_byte_buf<E>(self, bytes: Vec<u8>) -> Result<Encoded, E> {
                Ok(Encoded(bytes))
            }
        }
        d.deserialize_byte_buf(Bytes)
    }
}
