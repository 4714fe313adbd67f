//! Where everything meets.

pub mod catch_up;
