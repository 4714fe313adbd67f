//! Inputs of a run: the prepared dataset and its digests, first Gaussians from files, the threads and renderer of the
//! machine and whether its device is sound, signals.

pub mod dataset_print;
pub(crate) mod gaussian_pages;
pub mod machine;
pub mod page_check;
pub mod signals;
