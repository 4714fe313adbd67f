//! A killed or stopped run, resumed, ends with the bytes of an uninterrupted run. Through the real binary.

mod appearance;
mod bench;
mod changes;
mod ends;
mod events;
mod growth;
mod kills;
mod more_steps;
mod outliers;
mod ownership;
mod paths;
mod poses;
mod stops;
