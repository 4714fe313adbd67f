//! A killed or stopped run, resumed, ends with the bytes of an uninterrupted run. Through the real binary. What each feature of a run keeps
//! across a kill is in `matrix`.

mod bench;
mod changes;
mod ends;
mod events;
mod kills;
mod more_steps;
mod ownership;
mod paths;
mod stops;
