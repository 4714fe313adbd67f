//! What changes the number of Gaussians: strategies ([`strategy`]; gsplat's: [`mod@default`]), the statistics that they decide
//! by ([`stats`]), the edits that their rounds make to rows ([`ops`]), and applying logged events, late or on time
//! ([`replay`]).

pub mod default;
pub mod ops;
pub mod replay;
pub mod stats;
pub mod strategy;
