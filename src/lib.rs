//! gsscale trains 3D Gaussian Splatting scenes. This page is the tour, in the order in which data flows.
//!
//! ```text
//!  photos, poses, points ──> dataset ──> scene (rows in pages, events)      drive
//!                                          │                                 ^
//!            schedule (views) ──> paging (plan, frames)                      │
//!                                          │   └──> page (slots, engines) ───┘
//!            config ──> train ─────────────┤ pinned pages of the view's working set
//!                         │                v
//!                         │   kernels (one file per stage) ──> render (the stages in order)
//!                         │                │ gradients
//!                         └──> optim, densify <──┘
//!                                          │
//!                                          v
//!                      exchange (PLY, TensorBoard), metrics, pictures, report
//! ```
//!
//! | module | what it is responsible for |
//! | --- | --- |
//! | [`base`] | errors, names of pages, random draws, deterministic math, instruction paths; knows neither Gaussians nor disks |
//! | [`scene`] | Gaussians, cameras and images as data; first Gaussians from points; the log of global events |
//! | [`dataset`] | where views come from: COLMAP, transforms.json, MatrixCity, Mega-NeRF, the generated city; decoding photos |
//! | [`schedule`] | which view comes when, and which pages it needs |
//! | [`page`] | pages as bytes: buffers, slots on disk, checksums, the engines that move them, the map of versions and the commits that make them last |
//! | [`paging`] | one cache and one plan, for runs and for simulations: brings the pages of a view into memory and takes them back; writes a commit's pages beside training |
//! | [`checkpoint`] | the state of a run beside its pages, as bytes; how often a run is committed |
//! | [`gpu`] | a device and its memory, shaders, recording of work; knows no Gaussians |
//! | [`kernels`] | the ordered table of stages and each stage as a function on plain slices |
//! | [`render`] | the stages in order, on the CPU or a device: rows in, picture, loss, picture back, rows out; image metrics |
//! | [`optim`] | learning rates as a function of the step; dense Adam (oracle) and deferred Adam |
//! | [`densify`] | what changes the number of Gaussians: strategies, the statistics they decide by, the events they log, applying these |
//! | [`exchange`] | PLY in and out; what TensorBoard reads |
//! | [`config`] | what the user wrote, parsed once into the types of the rooms above, and what follows from it |
//! | [`report`] | pages for people: charts and pictures of what a run left behind |
//! | [`train`] | the only place where all of it meets: one step, the loop, evaluation, commits and `--resume`, what tools do with checkpoints |
//!
//! The programs are in `tools/`, one file each, with a folder where a program has several commands: they parse, call, print.
//!
//! One word, one thing: a *row* is one Gaussian inside a working set, a *column* one attribute of all of them, a
//! *view* a photo with its pose, a *target* its pixels, a *tile* 16x16 pixels, a *stage* one kernel of the pipeline,
//! a *batch* the part of a view's rows that a renderer takes in at once, a *step* one optimizer iteration, an *event* one global change that every row applies. A *page* is a group of rows that
//! travel together, a *slot* its place on disk, a *frame* its place in memory, a *plan* which pages coming steps need.

pub mod base;
pub mod checkpoint;
pub mod config;
pub mod dataset;
pub mod densify;
pub mod exchange;
pub mod gpu;
pub mod kernels;
pub mod optim;
pub mod page;
pub mod paging;
pub mod render;
pub mod report;
pub mod scene;
pub mod schedule;
pub mod train;
