//! gsscale trains 3D Gaussian Splatting scenes. This page is the tour, in the order in which data flows.
//! At its end: [how to add](#how-to-add) a key, a strategy, a loss term, a format, a resumable value, an eviction order.
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
//! | [`dataset`] | where views come from: COLMAP, transforms.json, MatrixCity, Mega-NeRF, OpenSfM, RealityCapture, the generated city; decoding photos |
//! | [`poses`] | camera poses of photos without any: runs COLMAP or pycolmap on pairs that it chooses; GPS to metres |
//! | [`schedule`] | which view comes when, and which pages it needs |
//! | [`page`] | pages as bytes: buffers, slots on disk, checksums, the engines that move them, the map of versions and the commits that make them last |
//! | [`paging`] | one cache and one plan, for runs and for simulations: brings the pages of a view into memory and takes them back; writes a commit's pages beside training |
//! | [`checkpoint`] | the state of a run beside its pages, as bytes; how often a run is committed |
//! | [`gpu`] | a device and its memory, shaders, recording of work; knows no Gaussians |
//! | [`kernels`] | the ordered table of stages and each stage as a function on plain slices |
//! | [`render`] | the stages in order, on the CPU or a device: rows in, picture, loss, picture back, rows out; image metrics |
//! | [`optim`] | learning rates as a function of the step; dense Adam (oracle) and deferred Adam |
//! | [`densify`] | what changes the number of Gaussians: strategies, the statistics they decide by, the events they log, applying these |
//! | [`photos`] | what a run learns of each photo: exposure and colours, where its camera really stands, what on it contradicts the rest of the scene; the one list of kinds: how each acts on a step, is saved, and what a report says about it |
//! | [`exchange`] | PLY in and out, SPZ out, SOG out and in; what TensorBoard reads |
//! | [`config`] | what the user wrote, parsed once into the types of the rooms above, and what follows from it |
//! | [`report`] | pages for people: charts and pictures of what a run left behind |
//! | [`train`] | the only place where all of it meets: one step, the loop, evaluation, commits and `--resume`, what tools do with checkpoints |
//! | [`cells`] | a city in cells, on several machines: the prior, the cut, a cell's run, the merge, the seam |
//!
//! As a library, in as many words as a training loop takes (`tools/examples` has whole programs):
//!
//! ```no_run
//! use gsscale::config::{file::TrainConfig, limits::RunOptions};
//! use gsscale::dataset::target_cache::TargetCache;
//! use gsscale::render::cpu::CpuRenderer;
//! use gsscale::train::{start::first_scene::prepare, state::trainer::Trainer};
//!
//! let config = TrainConfig { steps: 3000, ..TrainConfig::default() };
//! let first = prepare("scans/village".as_ref(), &config)?;
//! let options = RunOptions { sh_degree_start: first.sh_degree_start, ..RunOptions::new(&config, first.dataset.scene_scale) };
//! let photos = TargetCache::new(&first.dataset.views, 1 << 30, 2)?;
//! let mut trainer = Trainer::new(first.columns, &first.dataset, Box::new(CpuRenderer::new()), options)?;
//! for _ in 0..config.steps {
//!     let outcome = trainer.step(&first.dataset, &photos)?;
//!     println!("loss {}", outcome.loss.loss);
//! }
//! # Ok::<(), gsscale::train::error::TrainError>(())
//! ```
//!
//! The programs are in `tools/`, one file each, `bench` and `plan` with a folder of parts: they parse, call, print.
//! `tools/gsscale.rs` holds all of them as commands.
//!
//! One word, one thing: a *row* is one Gaussian inside a working set, a *column* one attribute of all of them, a
//! *view* a photo with its pose, a *target* its pixels, a *tile* 16x16 pixels, a *stage* one kernel of the pipeline,
//! a *batch* the part of a view's rows that a renderer takes in at once, a *step* one optimizer iteration, an *event* one global change that every row applies. A *page* is a group of rows that
//! travel together, a *slot* its place on disk, a *frame* its place in memory, a *plan* which pages coming steps need.
//!
//! # How to add
//!
//! Each list names the files in the order in which they change; paths are below `src` unless they say so. `cargo nextest run`
//! names what is forgotten: an undocumented key, a word that is not read, a state that does not come back, an
//! import that points the wrong way.
//!
//! **A config key**
//! 1. `config/file.rs`: one line in the list gives field, flag, help, default and the effect of a change
//!    ([`config::file::Class`]). `hidden` behind the class keeps it out of help: it is for work on the program, and `configs/README.md`
//!    names it. `common` also shows it in `-h` ([`config::file::Shown`]).
//! 2. `check` in `config/file.rs`: its range. An enumeration needs its words instead: one line in `config/values.rs`.
//! 3. `config/limits.rs`: puts the value into the options of the module that uses it. No module but `train` sees the config.
//! 4. `configs/default.toml`: `GSSCALE_WRITE_DEFAULT_CONFIG=1 cargo test --test inputs default_file` writes the
//!    file again, also after a change of a help text. Tests read the words of enumerations from
//!    [`config::values::choices`]. The lists below lead here wherever they add a key or a word.
//!
//! **A setting that one backend lacks**
//! 1. `render/mod.rs`: a method of [`render::Renderer`]. The backend that lacks the setting returns an error with its remedy.
//! 2. `train/run/begin.rs`, `begin`: asks the renderer before the output folder exists.
//!
//! **A densification strategy**
//! 1. `densify/` gets a file with the [`densify::strategy::Strategy`], which `densify/mod.rs` names. `densify/strategy.rs`: its name in
//!    [`densify::strategy::StrategyName`]. A round that needs other values than today's is an event kind in `scene/events.rs` with a
//!    [`densify::strategy::Round`], which [`densify::strategy::effect_of`] names.
//! 2. `config/values.rs`: the word of `--strategy`. `config/file.rs`: the keys. `config/limits.rs`: builds the
//!    strategy from the keys. `check` in `config/file.rs`: which keys it needs, and whether an optimizer on the device can do without it.
//! 3. What acts on the rows of a view in every step: [`densify::strategy::Strategy::add_gradients`] and
//!    [`densify::strategy::Strategy::after_update`]; `densify/mcmc.rs` is the example.
//! 4. Another fate of a row: its values in `densify/ops.rs`.
//!
//! **A growth score**
//! 1. `densify/long_axis.rs` ranks rows by [`densify::long_axis::GrowthScore`], from all gradients of the rows that a view has drawn.
//!    `collects_on_device` says which scores an optimizer on the device knows; the others are refused there.
//! 2. The word and its help, as above: `config/values.rs` and `config/file.rs`.
//!
//! **A camera model**
//! 1. `scene/camera.rs`: a field that [`scene::camera::Camera::pinhole`] sets and `lens_words` names, so that resumes and groups of
//!    photos tell it apart, and a constructor; `unproject`. `scene/frustum.rs`: slopes and offsets of the sides of what it can see.
//! 2. `kernels/project_fwd.rs`: a field of `View`, which on devices is `View` in `shared/camera.wgsl`, and the projection, with
//!    `shared/covariance.wgsl`; its gradient in `kernels/project_bwd.rs` and `project_bwd.wgsl`; `viewing_direction` in
//!    `kernels/sh_fwd.rs` and `shared/camera.wgsl`.
//! 3. `dataset/`: the reader that knows the model, undistortion, and `dataset/loader.rs`, which makes the camera. A focal length in metres of
//!    the world is multiplied by the scale of the frame. `dataset/disturb.rs` and `photos/pose.rs`, if the model comes that far.
//!
//! **A page codec**
//! 1. `page/format/slot_header.rs`: a [`page::format::slot_header::StoredAs`] with its number on the drive and its name, and a bit of the
//!    features, so that older programs refuse the slot. What lists codecs follows `StoredAs::ALL`.
//! 2. `page/format/codec.rs`: both directions, the word in `Codec::WORDS` and `FromStr`, and which codec writes the form.
//!
//! **A loss term** is a kind of [`photos`] that learns nothing, also where the term does not look at the photo:
//! 1. A file in `photos/`: a [`photos::parameter::PhotoParameter`] whose `adds_loss` and `needs_picture` are true. `target` gets the corrected picture
//!    and the photo that the loss compares, computes value and gradient, keeps both, and returns the photo. `loss` gives the value, which
//!    the log shows by the kind's name, `picture_back` adds the gradient, `begin_step` forgets both, because a step may show no picture. `buffer_bytes` counts the memory,
//!    `free_buffers` frees it. Masked pixels do not count, nor does a term of several pixels with one of them. Sums have a fixed order,
//!    for the same bits on any number of threads. `save` gives `Encoded::of(&())`. The test of `train/step/comparison.rs` has
//!    a small example. `first` returns `None` where the weight is 0, so that nothing changes.
//! 2. `photos/mod.rs`: the kind as the last of [`photos::KINDS`], and its weight in [`photos::PhotoOptions`].
//! 3. The key, as above: `config/file.rs`, `photos` in `config/limits.rs`, `check` of the keys for its range. `CHANGELOG.md` names it.
//! 4. Where the time of the term matters, the stage itself instead: `kernels/image_loss.rs` and `image_loss.wgsl` among the
//!    shaders. A run with such a kind records no steps ahead on a device: recorded steps compute the built-in
//!    loss alone.
//!
//! **A parameter of photos**
//! 1. A file in `photos/`: the values, their change of a picture, a photo or a camera, their derivatives, and what they learn, as
//!    a [`photos::parameter::PhotoParameter`]; its [`photos::parameter::Kind`] names it for commits, and says what the report shows.
//!    The trait's methods come in the order of a step; what is left out does nothing. Steps, the rehearsal, commits, resumes, the
//!    forecast, `summary.json` and the report follow. `photos/exposure/` acts on pictures, `photos/pose.rs` on
//!    cameras, `photos/outlier/blocks.rs` on photos.
//! 2. `photos/mod.rs`: its place in [`photos::KINDS`], and what the user asks for in [`photos::PhotoOptions`].
//! 3. The key, as above: `config/file.rs`, and `photos` in `config/limits.rs`. `check` in `config/file.rs` says if an optimizer on the device cannot do without gradients on the host.
//!
//! **An output format**
//! 1. `exchange/` gets a file with the format's `Format` (`exchange/sink.rs`), of which a [`exchange::sink::GaussianSink`] is made;
//!    `exchange/ply/write.rs` is the example.
//!    [`exchange::frames::ExportRows`] gives rows as files hold them, [`base::whole_file::PartFile`] makes the file appear as a
//!    whole, [`base::whole_folder::PartFolder`] a folder. `exchange/mod.rs` names the file.
//! 2. `exchange/format.rs`: the ending, the sink, the transform, the name in a run's folder, and how `--overwrite` removes it.
//!    Runs and `gsscale-ckpt export` follow. The PLY remains: resumes, `gsscale-eval` and more steps read it.
//!    `train/run/eval_file.rs` is where evaluation reads another format.
//! 3. `config/values.rs`: the word of `--export`. `config/file.rs`: the help of the key.
//!
//! **A resumable value**
//! 1. `checkpoint/run_state.rs`: a field of [`checkpoint::run_state::TrainerState`], a place in `encode` and `decode`, a new
//!    `VERSION`, and in `check` which values are impossible. A value by photo is a
//!    parameter of photos instead.
//! 2. `train/state/trainer.rs`: uses `self.state`. Commits and resumes need no change.
//! 3. `tests/fuzz/targets/map.rs`: the sample state. Only a new format of slots needs a new fixture (`tests/programs/ckpt/fixture.rs`).
//!
//! **An eviction order**
//! 1. `paging/frames/evict.rs`: a value of [`paging::frames::evict::EvictPolicy`], a place in `ALL`, its key of the order,
//!    and whether the order ignores the plan. Runs, look-ahead and simulations share it.
//!    `last_use` is the number of steps begun at the last pin, in runs and simulations; 0 for a page that was read ahead and not used yet.
//! 2. `config/values.rs`: the word of `--evict`. `config/file.rs`: the help of the key.
//! 3. `tests/storage/schedule.rs`: what the order must do, as a simple model.

pub mod base;
pub mod cells;
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
pub mod photos;
pub mod poses;
pub mod render;
pub mod report;
pub mod scene;
pub mod schedule;
pub mod train;
