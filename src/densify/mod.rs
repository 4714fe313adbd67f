//! Densification: strategies ([`strategy`]; gsplat's strategy: [`mod@default`];
//! splits along the longest axis: [`long_axis`], as far as more Gaussians pay: [`growth`]; relocation and noise: [`mcmc`]), the
//! statistics for their decisions
//! ([`stats`]), the edits of a round ([`ops`]), and the application of logged events, late or on time ([`replay`]).

pub mod default;
pub mod growth;
pub mod long_axis;
pub mod mcmc;
pub mod ops;
pub mod replay;
pub mod stats;
pub mod strategy;
