//! Where the photo scenes are.

#[path = "../../support/shared.rs"]
pub mod shared;
