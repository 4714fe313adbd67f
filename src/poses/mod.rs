//! Poses: a small rigid motion of the camera of each training photo, trained beside the scene (`--refine-poses`).
//!
//! A motion of the camera is the opposite motion of all Gaussians. So the gradients of the rows, which a step has anyway,
//! give that of the motion ([`gradient`]), and no stage of the renderer knows of it. Rates and bounds are shares of the
//! scene's scale ([`state`]).
//!
//! Scene and poses share a freedom: a scene that moves as a whole, with all of its cameras, gives the same pictures. Held-out
//! photos keep their poses, so what acts on a photo is its motion less the mean over the photos seen.
//!
//! Invariants: 1. the bits are the same for any number of threads, and for any cut of a view into batches; 2. no value that
//! is not finite or out of bounds is stored; 3. a camera without a motion keeps its bits.
//!
//! Not here: which step refines which view (`train`), and the bytes of a commit (`checkpoint`).

pub mod gradient;
pub mod motion;
pub mod state;
