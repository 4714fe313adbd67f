//! Identities: random 128-bit numbers that distinguish runs and stores.
//!
//! Invariant: two draws are practically never equal, on one machine or on two. An identity can only be compared.

use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::fmt;
use std::hash::{BuildHasher, Hasher, RandomState};
use std::str::FromStr;

/// Draws a number that practically no other call returns, on any machine.
pub fn draw_identity() -> u128 {
    // The standard library draws the keys of its hash maps from the system's random source.
    let draw = || RandomState::new().build_hasher().finish();
    let time = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(0, |d| d.as_nanos());
    (u128::from(draw()) << 64 | u128::from(draw())) ^ time ^ u128::from(std::process::id()) << 96
}

/// Identity of a training run, kept across resumes. The run's config.toml and every commit contain it.
///
/// As text (config.toml) it is 32 hexadecimal digits, in binary (run state) a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RunId(u128);

impl RunId {
    /// No run's identity: for a store that was imported, or salvaged without its run's config.
    pub const UNKNOWN: RunId = RunId(0);

    pub fn draw() -> RunId {
        RunId(draw_identity().max(1))
    }

    pub fn is_known(self) -> bool {
        self != RunId::UNKNOWN
    }

    /// Whether both are known and differ: then neither run may change the other's files.
    pub fn is_known_to_differ(self, other: RunId) -> bool {
        self.is_known() && other.is_known() && self != other
    }
}

impl fmt::Display for RunId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:032x}", self.0)
    }
}

impl FromStr for RunId {
    type Err = String;

    fn from_str(text: &str) -> Result<RunId, String> {
        let is_hex = text.len() == 32 && text.bytes().all(|b| b.is_ascii_hexdigit());
        let number = u128::from_str_radix(text, 16).ok().filter(|_| is_hex);
        number.map(RunId).ok_or_else(|| format!("'{text}' is not a run's identity, which is 32 hexadecimal digits"))
    }
}

impl Serialize for RunId {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        if to.is_human_readable() { to.collect_str(self) } else { to.serialize_u128(self.0) }
    }
}

impl<'de> Deserialize<'de> for RunId {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<RunId, D::Error> {
        match from.is_human_readable() {
            true => String::deserialize(from)?.parse().map_err(serde::de::Error::custom),
            false => u128::deserialize(from).map(RunId),
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    #[test]
    fn text_round_trips_and_other_text_is_refused() {
        let id = RunId::draw();
        assert_eq!(id.to_string().parse(), Ok(id));
        let json = serde_json::to_string(&id).unwrap();
        assert_eq!(serde_json::from_str::<RunId>(&json).unwrap(), id);
        for wrong in ["", "12", &format!("+{}", "0".repeat(31)), &"0".repeat(33)] {
            assert!(wrong.parse::<RunId>().is_err(), "{wrong}");
        }
        assert!(
            !RunId::UNKNOWN.is_known_to_differ(id)
                && !id.is_known_to_differ(id)
                && id.is_known_to_differ(RunId::draw())
        );
    }
}
