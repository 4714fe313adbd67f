//! What the kernels, the optimizers, densification and the renderers compute, on the CPU and on a device.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test

mod support;

mod color_correct;
mod cull;
mod deferred;
mod densify;
mod device_adam;
mod gpu_resident;
mod gpu_runtime;
mod gradients;
mod init;
mod lpips;
mod oracle;
mod parity;
mod poison;
mod poses;
mod shaders;
mod twins;
mod upright;
mod visibility;
mod weights;
