//! The keys of a run: one list defines the TOML file, the flags with their help and configs/default.toml, the defaults and the class of
//! each key (the effect of a change). Reading them, their ranges, and the relations between them. The config.toml of a run holds every
//! setting, and facts resolved at its start (`[resolved]`), which resume and evaluation read.
//!
//! Not here: words of enumerations ([`super::values`]).
//!
//! Invariants: 1. a key has the same kebab-case spelling in the file and as a flag; 2. flags override the file, the
//! file overrides the defaults; 3. unknown keys are refused; 4. the config.toml of a run is a valid `--config`; its
//! `[resolved]` table and the tables of [`super::published`] hold facts and are ignored when read.

use crate::base::error::{InputError, InputResult};
use crate::base::identity::RunId;
use crate::base::simd::SimdPath;
use crate::base::text::{has_raw_bytes, read_text, shown};
use crate::base::units::{parse_count, parse_count32};
use crate::base::whole_file::write_whole;
use crate::checkpoint::interval::CommitEvery;
use crate::config::habits::ALIASES;
use crate::config::values::{ByteSize, Chosen, Device, LogFormat, Residence, RgbColor, Schedule, Up};
use crate::densify::growth::Quality;
use crate::densify::long_axis::GrowthScore;
use crate::densify::strategy::StrategyName;
use crate::exchange::format::Exports;
use crate::exchange::meta::ExportFrame;
use crate::gpu::DeviceChoice;
use crate::optim::adam::EPS_MIN;
use crate::optim::method::{Method, OptimizerPlace};
use crate::optim::moments::Moments;
use crate::page::engine::open::IoEngine;
use crate::page::format::codec::Codec;
use crate::paging::frames::evict::EvictPolicy;
use crate::paging::prefetch::Transfers;
use crate::photos::exposure::AppearanceMode;
use crate::render::SsimPadding;
use crate::render::color_correct::ColorCorrect;
use crate::render::metrics::SsimVariant;
use crate::schedule::order::Order;
use clap::Args as _;
use clap::error::{ContextKind, ContextValue};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Tables of a config file that hold facts instead of settings.
pub(super) const TABLES: [&str; 3] = ["resolved", "published", "tier"];

/// Longest config file, bytes; a file with every key has some 8 KB.
pub const FILE_BYTES_MAX: u64 = 1 << 20;

/// Most steps of a run: the optimizer keeps [`crate::optim::drift::STEP_BYTES`] for each.
const STEPS_MAX: u32 = 10_000_000;
/// Most random points to start from.
const INIT_POINTS_MAX: u32 = 100_000_000;
/// Most worker threads: a typing error must not fill memory with stacks.
const THREADS_MAX: u32 = 1024;

/// Fewest and most rows of a page: below, the index and the headers outweigh the rows; above, a page is 48 MB.
const PAGE_ROWS_MIN: u32 = 16;
const PAGE_ROWS_MAX: u32 = 65_536;

/// The word behind a key's class as a [`Shown`].
macro_rules! shown {
    () => {
        Shown::InGroup
    };
    (common) => {
        Shown::First
    };
    (hidden) => {
        Shown::Nowhere
    };
}

macro_rules! config_keys {
    ($($heading:literal { $( $(#[doc = $doc:literal])+ $([$($arg:tt)+])? $name:ident: $ty:ty = $default:expr => $class:ident $($shown:ident)?; )+ })+) => {
        /// All keys of a run with their values.
        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields, default, rename_all = "kebab-case")]
        pub struct TrainConfig { $($( $(#[doc = $doc])+ pub $name: $ty, )+)+ }

        impl Default for TrainConfig {
            fn default() -> Self { TrainConfig { $($( $name: $default, )+)+ } }
        }

        /// The keys as flags; `None` for flags that were not given.
        #[derive(Debug, Clone, Default, clap::Args)]
        pub struct TrainOverrides {
            $($( $(#[doc = $doc])+ #[arg(long, help_heading = $heading, allow_negative_numbers = true $(, $($arg)+)?)] pub $name: Option<$ty>, )+)+
        }

        impl TrainOverrides {
            /// Overrides `config` with the given flags.
            pub fn apply(self, config: &mut TrainConfig) { $($( if let Some(v) = self.$name { config.$name = v; } )+)+ }

            /// Those of the flags whose keys `keeps` accepts, by their fields.
            #[must_use]
            pub fn only(mut self, keeps: impl Fn(&str) -> bool) -> TrainOverrides {
                $($( if !keeps(stringify!($name)) { self.$name = None; } )+)+
                self
            }

            /// The fields of the given flags.
            pub fn given(&self) -> Vec<&'static str> {
                let mut fields = Vec::new();
                $($( if self.$name.is_some() { fields.push(stringify!($name)); } )+)+
                fields
            }
        }

        /// Every key, in order.
        pub const KEYS: &[ConfigKey] = &[$($(
            ConfigKey { heading: $heading, field: stringify!($name), meaning: concat!($($doc, "\n"),+), class: Class::$class, shown: shown!($($shown)?) },
        )+)+];
    };
}

config_keys! {
    "Dataset" {
        /// Folder of the photos inside the scene; empty = where the dataset says (COLMAP: images)
        images: String = String::new() => Place;
        /// Reduce photos by this factor (may be fractional: 3.4175)
        data_factor: f64 = 1.0 => Numbers;
        /// Longest side of a photo in pixels after --data-factor; 0 = no limit
        [value_parser = parse_count32] max_resolution: u32 = 0 => Numbers common;
        /// Hold out every N-th photo, names in sorted order (index % N == 0); 0 = none
        [value_parser = parse_count32] test_every: u32 = 8 => Numbers;
        /// Hold out every photo whose index is greater than N, instead of --test-every; -1 = off
        test_after: i64 = -1 => Numbers hidden;
        /// Use only the photos that this file lists, a name on each line. The frame of the scene, and which photos are held out,
        /// follow from all photos. Empty = all photos
        views_file: String = String::new() => Derived;
        /// Use masks found in masks/ (white = keep), and the alpha of photos as a mask (opaque = keep). Without, transparent
        /// pixels show --background
        [num_args = 0..=1, default_missing_value = "true", require_equals = true] masks: bool = true => Numbers;
        /// White in masks means leave out
        [num_args = 0..=1, default_missing_value = "true", require_equals = true] invert_masks: bool = false => Numbers;
        /// Train without the photos that are registered but missing
        [num_args = 0..=1, default_missing_value = "true", require_equals = true] allow_missing: bool = false => Place;
        /// Memory for decoded photos
        image_cache: ByteSize = ByteSize(1 << 30) => Free;
        /// Near plane, relative to the size of the scene
        near_plane: f64 = 0.01 => Numbers hidden;
        /// Start from this PLY (Gaussians if it has f_dc_0, else coloured points), from the finest level of SOGs (lod-meta.json), or
        /// from the last generation of this store folder (see gsscale-ckpt import), which may exceed memory. Empty = the dataset's
        /// points
        init_ply: String = String::new() => Derived;
        /// Start from these pages of the store of --init-ply only: a file with a page on each line, as `12`, or `12 frozen` for a
        /// page that is rendered and never changes. Empty = all pages, none frozen
        pages_file: String = String::new() => Derived hidden;
        /// Random points in the views' frusta when the dataset has none and --sweep-points finds too few; 0 = refuse such a dataset
        [value_parser = parse_count32] init_points: u32 = 100_000 => Numbers;
    }
    "Training" {
        /// Total number of steps; --resume can raise it (see --keep-checkpoint)
        [value_parser = parse_count32] steps: u32 = 30_000 => Length common;
        /// Steps over which learning rates decay; they are constant afterwards. 0 = --steps, and with --strategy long-axis and
        /// --schedule run-length at most 150 for each training photo. A resumed run keeps its first value
        [value_parser = parse_count32] schedule_steps: u32 = 0 => Derived hidden;
        /// Values of --sh-every, --refine-start, --refine-every, --refine-stop and --means-lr, with --strategy long-axis
        /// also of --scales-lr, --quats-lr, --shn-lr and --others-lr-final, where they are not given: run-length (by --steps;
        /// the classic values from 30,000 steps on, except that others-lr-final is 0.1) or classic (their defaults in
        /// configs/default.toml). A resumed run keeps its values
        schedule: Schedule = Schedule::RunLength => Free;
        /// Seed of every random draw
        [value_parser = parse_count] seed: u64 = 42 => Numbers;
        /// Highest degree of spherical harmonics (SH), 0 to 3
        sh_degree: u8 = 3 => Layout;
        /// Raise the SH degree every N steps; 0 = full degree from the start
        [value_parser = parse_count32] sh_every: u32 = 1000 => Numbers hidden;
        /// SH degree of the first step
        sh_start: u8 = 0 => Numbers hidden;
        /// Order of the photos: auto, shuffle, groups:N (N spatial groups, shuffled within) or tour (a path through
        /// all). auto is shuffle if the scene fits in memory or reads are few, else groups
        view_order: Chosen<Order> = Chosen(None) => Numbers;
        /// Capacity of a page, Gaussians. Fixed for a run, because it changes the rounding
        [value_parser = parse_count32] page_rows: u32 = 1024 => Layout hidden;
        /// Weight of 1 - SSIM in the loss; the rest is L1
        ssim_lambda: f64 = 0.2 => Numbers;
        /// Pixels of the SSIM in the loss: valid (windows inside the image) or same (zero padded)
        ssim_padding: SsimPadding = SsimPadding::Valid => Numbers hidden;
        /// Learning rate of positions, times the scene scale
        means_lr: f64 = 1.6e-4 => Numbers;
        /// Learning rate of positions at the last step, as a fraction of --means-lr
        means_lr_final: f64 = 0.01 => Numbers hidden;
        /// Learning rate of log-scales
        scales_lr: f64 = 5e-3 => Numbers hidden;
        /// Learning rate of quaternions
        quats_lr: f64 = 1e-3 => Numbers hidden;
        /// Learning rate of logit opacities
        opacities_lr: f64 = 5e-2 => Numbers hidden;
        /// Learning rate of the constant SH band
        sh0_lr: f64 = 2.5e-3 => Numbers hidden;
        /// Learning rate of the higher SH bands
        shn_lr: f64 = 2.5e-3 / 20.0 => Numbers hidden;
        /// Learning rates of everything but positions at the last step, as a fraction: they fall over the last tenth of the
        /// run. 1 = they are constant
        others_lr_final: f64 = 1.0 => Numbers hidden;
        /// Adam's epsilon, 1e-16 to 1: below 1e-16 it is lost in the f32 rounding of second moments
        adam_eps: f64 = 1e-15 => Numbers hidden;
        /// Which Gaussians Adam updates: deferred (all; those without a gradient when next visible), dense (all at
        /// every step: slow, for comparison), or sparse (only those with a gradient: not exact)
        optimizer: Method = Method::Deferred => Numbers hidden;
        /// Where the optimizer runs: host, or device (on the GPU that renders, in pages that stay there while --device-mem
        /// has room; with --optimizer deferred and --growth-score gradient). The two round differently.
        /// auto is host, until device is faster on measured GPUs. A resumed run keeps its place
        optimizer_on: Chosen<OptimizerPlace> = Chosen(None) => Numbers;
        /// Format of Adam's moments: f32, or bf16 (not exact; halves their size on disk and on a device that holds pages)
        moments: Moments = Moments::F32 => Numbers;
        /// Initial opacity
        init_opacity: f64 = 0.1 => Numbers hidden;
        /// Initial size, times the distance to the three nearest neighbours
        init_scale: f64 = 1.0 => Numbers;
        /// For few or random first points: --growth-score mixed, --recycle 0.05, --init-scale 2 and 6.7 times the --means-lr of
        /// --schedule, where they are not given. Photos that overlap little lose by it. auto is on where the first points do
        /// not have the colours that photos show there, photos overlap much, and --max-gaussians is given: a count that the run decides
        /// itself does better without. A resumed run keeps its values
        [num_args = 0..=1, default_missing_value = "on", require_equals = true] poor_points: Chosen<bool> = Chosen(None) => Free hidden;
        /// Begin from points that the photos agree on, found by moving patches of photos through depths (a plane sweep; seconds for 150
        /// photos), instead of the points of the scene. auto is on where the scene has no points, or points whose colours photos do not
        /// show there, and the sweep finds enough. A resumed run keeps its Gaussians
        [num_args = 0..=1, default_missing_value = "on", require_equals = true] sweep_points: Chosen<bool> = Chosen(None) => Free;
        /// Upper clamp of alpha (0.999 reproduces gsplat before 2026)
        max_alpha: f64 = 0.99 => Numbers hidden;
        /// Correct the pictures by values trained for each photo: off, exposure (one number for each photo), if-needed (exposure, which
        /// the run drops after four passes over the photos if they differ by less than .2 stops) or full (also eight
        /// numbers for its colours, and the vignetting of each camera). auto is exposure where the exposures of photos differ by
        /// .2 stops or more, measured at the first points, full where their colours do, if-needed where the points say nothing,
        /// else off. Exposures
        /// start from the EXIF data of the photos if more than half of them state time, f-number and ISO. On the CPU, exposure
        /// costs about a tenth of a step and full two fifths; on a GPU the picture and its gradient also cross the bus twice.
        /// gsscale-eval fits these values to the left halves of held-out photos
        appearance: Chosen<AppearanceMode> = Chosen(None) => Numbers;
        /// With --appearance, start from the values of another run's photos, and hold their mean: its appearance.json. Empty = none
        first_appearance: String = String::new() => Derived hidden;
        /// Leave out views whose photo contradicts the scene (a wrong pose, a photo of another place) for as long as it does.
        /// auto is on where the first points contradict a photo before training. The log and the report name such views with and
        /// without this key
        [num_args = 0..=1, default_missing_value = "on", require_equals = true] robust_views: Chosen<bool> = Chosen(None) => Numbers;
        /// Mask the parts of photos that contradict the scene (cars, people, shadows that moved) for as long as they do. The
        /// side of a masked block is a 64th of the photo's longer side. Pixels beside a masked block that have its colour are
        /// masked too. At most a quarter of the blocks of a photo is masked, from a tenth of the run on (step 500 at the
        /// latest). Masks of your own work better: see --masks. auto begins without masks, and goes on with them if photos contradict
        /// each other after six passes (600 steps at least, half the run at most): at 3 % of the first points that they show. Runs that begin
        /// from Gaussians or random points, and runs of fewer than 1,200 steps, have none
        [num_args = 0..=1, default_missing_value = "on", require_equals = true] robust_pixels: Chosen<bool> = Chosen(None) => Numbers;
        /// Refine the poses of training photos: after the first tenth of the run, and two passes over the photos, each camera moves
        /// to where the scene fits its photo, by at most 2 % of the scene's size. For poses with noise; held-out photos keep theirs. auto is on where photos
        /// agree better with the first points when they are moved by some pixels. poses.json has the refined ones. Not with
        /// --optimizer-on device
        [num_args = 0..=1, default_missing_value = "on", require_equals = true] refine_poses: Chosen<bool> = Chosen(None) => Numbers;
        /// Background colour, RGB in 0..1
        [value_name = "R,G,B"] background: RgbColor = RgbColor([0.0; 3]) => Numbers;
    }
    "Densification" {
        /// long-axis (split along the longest axis; at --max-gaussians, or at the number that --quality decides, remove the
        /// Gaussians that contribute least), default (that of gsplat: clone, split, prune, reset), mcmc (3DGS-MCMC, as gsplat's:
        /// relocation of faint Gaussians, 5 % growth a round, noise on positions; needs --max-gaussians, not with --optimizer-on
        /// device), or none
        strategy: StrategyName = StrategyName::LongAxis => Numbers;
        /// With --strategy long-axis, grow first the Gaussians with the largest screen-space gradient (gradient), with the
        /// largest squared error in the pixels that they cover (error), or with the largest geometric mean of both (mixed)
        growth_score: GrowthScore = GrowthScore::Gradient => Numbers hidden;
        /// With --strategy long-axis, the share of the Gaussians seen that a round at the cap removes; 0 = none
        recycle: f64 = 0.02 => Numbers hidden;
        /// draft (few Gaussians), normal or archive (many); with --strategy long-axis and no --max-gaussians. The run holds out
        /// some training photos during three quarters of it (at most 2,200 steps). The scene grows as long as more Gaussians bring
        /// these photos enough decibels
        quality: Quality = Quality::Normal => Numbers common;
        /// Largest number of Gaussians; 0 = no cap (with --strategy long-axis: --quality decides)
        [value_parser = parse_count] max_gaussians: u64 = 0 => Numbers common;
        /// Step after which densification rounds begin
        [value_parser = parse_count32] refine_start: u32 = 500 => Numbers;
        /// Step at which densification rounds and opacity resets end
        [value_parser = parse_count32] refine_stop: u32 = 15_000 => Numbers;
        /// Steps between densification rounds. With --strategy long-axis and --view-order groups:N or tour, a round comes after
        /// each pass over the photos if a pass has more steps
        [value_parser = parse_count32] refine_every: u32 = 100 => Numbers;
        /// Steps between opacity resets (to twice --prune-opa); 0 = never. No reset comes in the last steps of the planned run
        /// (a third of this number, at most 1,000), because opacities need steps to recover
        [value_parser = parse_count32] reset_every: u32 = 3000 => Numbers hidden;
        /// Grow Gaussians whose mean screen-space gradient exceeds this
        grow_grad2d: f64 = 2e-4 => Numbers hidden;
        /// Growing Gaussians up to this size (times the scene scale) are cloned, larger ones split
        grow_scale3d: f64 = 0.01 => Numbers hidden;
        /// Remove Gaussians with a lower opacity; 0 = none, and no opacity resets. With --strategy mcmc, relocate them
        prune_opa: f64 = 0.005 => Numbers hidden;
        /// Remove Gaussians larger than this (times the scene scale), after the first --reset-every steps
        prune_scale3d: f64 = 0.1 => Numbers hidden;
    }
    "Output" {
        /// Evaluate on the held-out photos every N steps; 0 = only at the end
        [value_parser = parse_count32] eval_every: u32 = 0 => Free;
        /// Write a PLY and keep a named checkpoint (step-N) every N steps, which goes at the end without --keep-checkpoint; 0 = only
        /// a PLY at the end
        [value_parser = parse_count32] save_every: u32 = 0 => Free;
        /// Write a line of metrics every N steps
        [value_parser = parse_count32] log_every: u32 = 100 => Free;
        /// Log of metrics: json (metrics.jsonl), or tensorboard (event files as well)
        log: LogFormat = LogFormat::Json => Free;
        /// SSIM to report: same (zero padded, as the 3DGS code), valid or reflect
        ssim_variant: SsimVariant = SsimVariant::Same => Reported hidden;
        /// Also report colour-corrected PSNR: affine (per channel, as gsplat), quadratic (as Zip-NeRF and nerfstudio)
        /// or off. It is not comparable with PSNR
        [alias = "colour-correct"] color_correct: Chosen<ColorCorrect> = Chosen(None) => Free;
        /// Files of the result: ply, spz, sog or several (spz,sog). A PLY is always written; spz adds a file of about a tenth of its
        /// bytes, sog a folder with levels of detail, which web viewers load in parts
        export: Exports = Exports { spz: false, sog: false } => Free common;
        /// Leave Gaussians that fewer than two photos see out of the result files (the checkpoint keeps them): auto, on or off.
        /// auto is on where these are at most .1 % of all; otherwise it leaves out those that no photo sees, if they are at most .1 %
        export_clean: Chosen<bool> = Chosen(None) => Free;
        /// Coordinates of the exported files (PLY, SPZ, SOG): dataset or local
        export_frame: ExportFrame = ExportFrame::Dataset => Free;
        /// Up in the exported files: auto (from cameras and points), keep (the axes of the dataset) or X,Y,Z (this direction
        /// of the dataset). They are turned so that viewers show up as up: -y in a PLY and a SOG, y in an SPZ. Training is not
        /// affected. Each file has its transform back to the dataset: point_cloud.transform.json,
        /// point_cloud.spz.transform.json, transform.json in the folder of a SOG
        [allow_hyphen_values = true] up: Up = Up::Auto => Free;
    }
    "Memory and disk" {
        /// Memory limit of the run; 0 = 70 % of the memory available on this machine or in its control group
        host_mem: ByteSize = ByteSize(0) => Free common;
        /// Folder on a fast drive for pages that do not fit in memory; it is also the checkpoint of the run. Empty =
        /// all pages stay in memory, and the checkpoint is the folder `checkpoint` inside --out
        spill_dir: String = String::new() => Lasting common;
        /// Keep the checkpoint at the end of the run, for more steps later or for gsscale-ckpt. Otherwise it is kept
        /// only if the run stops early
        [num_args = 0..=1, default_missing_value = "true", require_equals = true] keep_checkpoint: bool = false => Lasting;
        /// Most pages in memory; 0 = as many as --host-mem allows
        [value_parser = parse_count32] frames: u32 = 0 => Free hidden;
        /// I/O engine for pages: auto, uring, mmap or pread. Never changes results. mmap reads through memory maps: if another
        /// program makes a page file shorter during a read, the system ends the run (SIGBUS), and --resume continues it
        io: IoEngine = IoEngine::Auto => Free hidden;
        /// Codec of stored pages. auto = halves for --moments bf16, else raw; gsscale-iotune advises zstd:LEVEL for slow
        /// drives. Never changes results
        spill_codec: Chosen<Codec> = Chosen(None) => Free;
        /// Time between commits (90, 90s, 5min), which is the most that a killed run loses. 0 = only on a stop request and after the
        /// last step. auto = every 10 s while commits delay training by less than 1 %, else at least every minute; longer only if
        /// commits would write more than 256 GiB an hour, or in memory 24 times the scene and at least 16 GiB. Never changes results
        commit_every: CommitEvery = CommitEvery::Auto => Free;
        /// Seconds to wait for space on a full drive before the run stops with its last commit; a run in memory goes on
        /// without commits if its results have room
        disk_full_wait: f64 = 600.0 => Free hidden;
        /// Which page to evict: belady (farthest next use) or lru. Never changes results
        evict: EvictPolicy = EvictPolicy::FarthestNextUse => Free hidden;
        /// When pages move: overlap (during steps), ahead (prefetched between steps, which wait) or demand (when a step
        /// needs them). The last two are for comparison. Never changes results
        transfers: Transfers = Transfers::Overlap => Free hidden;
        /// Most bytes of prefetched pages; 0 = an eighth of the frames
        prefetch_bytes: ByteSize = ByteSize(0) => Free hidden;
    }
    "Machine" {
        /// Worker threads; 0 = one per core. Never changes results
        [value_parser = parse_count32] threads: u32 = 0 => Free;
        /// Instruction path: auto, avx512, avx2 or baseline. Each path always gives the same bits
        simd: Chosen<SimdPath> = Chosen(None) => Instructions hidden;
        /// Renderer: auto (a hardware GPU, else the CPU), gpu (also a software adapter), cpu, or a number (#2) or part of a
        /// name from --list-devices
        device: Device = Device::Gpu(DeviceChoice::Auto) => Free common;
        /// Memory limit on the device; 0 = all of its memory
        device_mem: ByteSize = ByteSize(0) => Free;
    }
}

impl TrainConfig {
    /// Reads a config file over the defaults.
    /// Errors: the file cannot be read, is no config, or has an unknown key or word.
    pub fn read(path: &Path) -> InputResult<TrainConfig> {
        Ok(TrainConfig::read_with_keys(path)?.0)
    }

    /// As [`TrainConfig::read`], with the fields of the keys that the file gives. Errors: as [`TrainConfig::read`].
    pub fn read_with_keys(path: &Path) -> InputResult<(TrainConfig, BTreeSet<String>)> {
        let text = read_text(path, FILE_BYTES_MAX, "give a TOML file of keys")?;
        let of_code_page = |(_, line): &(usize, &str)| has_raw_bytes(line.split('#').next().unwrap_or(""));
        if let Some((at, line)) = text.lines().enumerate().find(of_code_page) {
            let problem = format!("the text is not UTF-8: {}", shown(line.trim()));
            return Err(InputError::new(path, problem, "save the file as UTF-8").at(format!("line {}", at + 1)));
        }
        TrainConfig::parse_with_keys(&text)
            .map_err(|problem| InputError::new(path, problem, "see configs/default.toml for every key and its meaning"))
    }

    /// Parses a config text over the defaults. Errors: the text is no TOML, or has an unknown key or value.
    pub fn parse(text: &str) -> Result<TrainConfig, String> {
        Ok(TrainConfig::parse_with_keys(text)?.0)
    }

    /// As [`TrainConfig::parse`], with the fields of the keys that the text gives. Errors: as [`TrainConfig::parse`].
    pub fn parse_with_keys(text: &str) -> Result<(TrainConfig, BTreeSet<String>), String> {
        let mut table: toml::Table = text.parse().map_err(|e: toml::de::Error| e.to_string())?;
        for name in TABLES {
            table.remove(name);
        }
        let place = |key: &str| {
            let name = |line: &str| line.split('=').next().unwrap_or("").trim().trim_matches(['"', '\'']).to_string();
            let line = text.lines().position(|line| name(line) == key);
            line.map_or(String::new(), |at| format!("line {}: ", at + 1))
        };
        let given = table.keys().map(|key| key.replace('-', "_")).collect();
        Ok((TrainConfig::from_table(table, place)?, given))
    }

    /// The values of a table over the defaults. A count may be a text, as its flag takes it: `"2M"`.
    /// Errors: begin with the `place` of the key that does not exist or takes no such value.
    pub fn from_table(table: toml::Table, place: impl Fn(&str) -> String) -> Result<TrainConfig, String> {
        let read = |(key, value): (String, toml::Value)| {
            let value = value_of_key(&key, value).map_err(|problem| place(&key) + &problem)?;
            Ok((key, value))
        };
        let table = table.into_iter().map(read).collect::<Result<toml::Table, String>>()?;
        TrainConfig::deserialize(table).map_err(|e| e.to_string())
    }

    /// Checks ranges and relations between keys. Not here: whether files exist and whether a run fits.
    /// Errors: names the first key that is out of range, with what is allowed.
    pub fn check(&self) -> InputResult<()> {
        let positive = |x: f64| x.is_finite() && x > 0.0;
        // Compared in f32, as the run computes: 0.99999998 is 1 there.
        let is_between = |x: f64, least: f32| x as f32 > least && (x as f32) < 1.0;
        let is_interval = !matches!(self.commit_every, CommitEvery::Seconds(s) if !(s >= 0.0 && s.is_finite()));
        let threshold = |x: f64| x >= 0.0 && x.is_finite();
        let rate = |x: f64| (0.0..=1e6).contains(&x);
        let fraction = |x: f64| x > 0.0 && x <= 1.0;
        let (from_0, to_1e6, to_1) = ("a number from 0 on", "a number from 0 to 1e6", "a number above 0 and up to 1");
        let checks = [
            ("data-factor", self.data_factor.is_finite() && self.data_factor >= 1.0, "1 or more"),
            ("test-after", self.test_after >= -1, "an index from 0 on, or -1 to hold out by --test-every"),
            ("near-plane", positive(self.near_plane), "a positive number"),
            // TOML, in which runs keep their settings, has no larger numbers.
            ("seed", i64::try_from(self.seed).is_ok(), "0 to 9,223,372,036,854,775,807"),
            ("sh-degree", self.sh_degree <= 3, "0, 1, 2 or 3"),
            ("sh-start", self.sh_start <= self.sh_degree, "0 to --sh-degree"),
            ("page-rows", (PAGE_ROWS_MIN..=PAGE_ROWS_MAX).contains(&self.page_rows), "16 to 65536"),
            ("steps", (1..=STEPS_MAX).contains(&self.steps), "1 to 10,000,000"),
            ("schedule-steps", self.schedule_steps <= STEPS_MAX, "0 to 10,000,000"),
            ("max-gaussians", self.max_gaussians < u64::from(u32::MAX), "less than 4,294,967,295, or 0 for no cap"),
            ("init-points", self.init_points <= INIT_POINTS_MAX, "0 to 100,000,000"),
            ("threads", self.threads <= THREADS_MAX, "0 to 1024"),
            ("ssim-lambda", (0.0..=1.0).contains(&self.ssim_lambda), "0 to 1"),
            ("init-opacity", is_between(self.init_opacity, 0.0), "a number between 0 and 1, at most 0.9999999"),
            ("init-scale", positive(self.init_scale), "a positive number"),
            (
                "max-alpha",
                is_between(self.max_alpha, 0.5),
                "a number between 0.5 and 1, such as 0.99 or 0.999, at most 0.9999999",
            ),
            ("background", self.background.0.iter().all(|c| (0.0..=1.0).contains(c)), "three numbers in 0..1"),
            ("refine-every", self.refine_every > 0, "1 or more"),
            ("commit-every", is_interval, "auto, or a number of seconds from 0 on"),
            ("disk-full-wait", (0.0..=1e9).contains(&self.disk_full_wait), "a number of seconds from 0 on"),
            ("log-every", self.log_every > 0, "1 or more"),
            ("grow-grad2d", threshold(self.grow_grad2d), from_0),
            ("grow-scale3d", threshold(self.grow_scale3d), from_0),
            ("prune-opa", threshold(self.prune_opa), from_0),
            ("prune-scale3d", threshold(self.prune_scale3d), from_0),
            ("recycle", (0.0..=0.5).contains(&self.recycle), "a share from 0 to 0.5"),
            // Compared in f32, as events store the value.
            ("prune-opa", (self.prune_opa as f32) < 0.5, "less than 0.5"),
            ("means-lr", rate(self.means_lr), to_1e6),
            ("scales-lr", rate(self.scales_lr), to_1e6),
            ("quats-lr", rate(self.quats_lr), to_1e6),
            ("opacities-lr", rate(self.opacities_lr), to_1e6),
            ("sh0-lr", rate(self.sh0_lr), to_1e6),
            ("shn-lr", rate(self.shn_lr), to_1e6),
            ("means-lr-final", fraction(self.means_lr_final), to_1),
            ("others-lr-final", fraction(self.others_lr_final), to_1),
        ];
        if let Some((key, _, allowed)) = checks.iter().find(|(_, is_allowed, _)| !is_allowed) {
            let table = toml::Table::try_from(self).unwrap_or_default();
            let value = table.get(*key).map_or("the value".to_string(), ToString::to_string);
            return Err(InputError::new(
                format!("--{key}"),
                format!("{value} is out of range"),
                format!("use {allowed}"),
            ));
        }
        if self.strategy == StrategyName::Mcmc && self.max_gaussians == 0 {
            let problem = "it grows up to a cap, and there is none";
            return Err(InputError::new("--strategy mcmc", problem, "give --max-gaussians N, such as 1000000"));
        }
        if self.sweep_points.is_on() && !self.init_ply.is_empty() {
            let problem = "it looks for first points, and --init-ply gives them";
            return Err(InputError::new("--sweep-points", problem, "leave out one of the two"));
        }
        self.check_place()?;
        if (EPS_MIN..=1.0).contains(&self.adam_eps) {
            return Ok(());
        }
        let problem = format!(
            "{:e} is out of range: below 1e-16, second moments that f32 rounds to zero let Gaussians leave the bounds \
             of their pages; above 1, training stands still",
            self.adam_eps
        );
        Err(InputError::new("--adam-eps", problem, "use 1e-16 to 1; 1e-15 is usual"))
    }

    /// What an optimizer on a device does not do.
    fn check_place(&self) -> InputResult<()> {
        if self.optimizer_on != Chosen(Some(OptimizerPlace::Device)) {
            return Ok(());
        }
        let needs = [
            (self.device != Device::Cpu, "it needs a GPU", "use --device gpu"),
            (self.optimizer == Method::Deferred, "it supports the deferred form only", "use --optimizer deferred"),
            (self.pages_file.is_empty(), "it knows no frozen pages", "leave out --pages-file"),
            (!self.refine_poses.is_on(), "it leaves the gradients of poses on the device", "leave out --refine-poses"),
            (self.strategy != StrategyName::Mcmc, "it adds no noise to means", "leave out --strategy mcmc"),
        ];
        match needs.iter().find(|(holds, ..)| !holds) {
            Some((_, problem, remedy)) => {
                let remedy =
                    format!("{remedy}, or --optimizer-on host (with --accept-changes for a run that has begun)");
                Err(InputError::new("--optimizer-on device", *problem, &remedy))
            }
            None => Ok(()),
        }
    }

    /// Where the pages of the run live.
    pub fn residence(&self) -> Residence<'_> {
        match (self.spill_dir.as_str(), self.frames) {
            ("", 0) => Residence::Memory,
            ("", _) => Residence::Frames,
            (folder, _) => Residence::SpillDir(Path::new(folder)),
        }
    }
}

#[derive(Debug, Clone, Copy)]
pub struct ConfigKey {
    pub heading: &'static str,
    /// Its field in [`super::file::TrainConfig`], also the id of the flag.
    pub field: &'static str,
    /// Its meaning, for help and for configs/default.toml.
    pub meaning: &'static str,
    pub class: Class,
    pub shown: Shown,
}

impl ConfigKey {
    /// Its name in files and on the command line, in kebab-case.
    pub fn name(&self) -> String {
        self.field.replace('_', "-")
    }
}

/// The value that a table gives a key, a count as a number.
/// Errors: there is no such key (the error has the most similar one), or the key takes no such value.
fn value_of_key(key: &str, value: toml::Value) -> Result<toml::Value, String> {
    if !KEYS.iter().any(|known| known.name() == key) {
        let tip = similar_key(key).map_or(String::new(), |similar| format!("; perhaps {similar} is meant"));
        return Err(format!("there is no key {key}{tip}"));
    }
    let check =
        |value: &toml::Value| TrainConfig::deserialize(toml::Table::from_iter([(key.to_string(), value.clone())]));
    let Err(error) = check(&value) else { return Ok(value) };
    let count = value.as_str().and_then(|text| i64::try_from(parse_count(text).ok()?).ok()).map(toml::Value::Integer);
    count.filter(|count| check(count).is_ok()).ok_or_else(|| format!("{key}: {}", error.message()))
}

/// The key that other programs call by this name, or that the name resembles most.
fn similar_key(name: &str) -> Option<String> {
    let name = name.replace('_', "-");
    let is_ours = KEYS.iter().any(|key| key.name() == name);
    let same = ALIASES.iter().find(|(names, _)| names.contains(&name.as_str())).map(|(_, key)| (*key).to_string());
    if let Some(key) = same.or_else(|| is_ours.then(|| name.clone())) {
        return Some(key);
    }
    let flags = TrainOverrides::augment_args(clap::Command::new("keys").no_binary_name(true));
    let error = flags.try_get_matches_from([format!("--{name}")]).err()?;
    let ContextValue::String(flag) = error.get(ContextKind::SuggestedArg)? else { return None };
    flag.trim_start_matches('-').split([' ', '=']).next().map(str::to_string)
}

/// Where help shows a key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shown {
    /// In `-h` and in `--help`: most runs give it.
    First,
    /// In `--help`.
    InGroup,
    /// In configs/README.md and configs/default.toml alone: it is for work on the program, and for comparisons.
    Nowhere,
}

/// The effect of a changed key on a resumed run, and on the comparison with a published run.
///
/// | class | on `--resume` | compared with a published run |
/// | --- | --- | --- |
/// | `Numbers` | refused without `--accept-changes` | another run |
/// | `Layout` | refused | another run |
/// | `Derived` | its derived value is compared | another run |
/// | `Instructions` | its derived value is compared | the same run |
/// | `Place` | refused without `--accept-changes` | the same run |
/// | `Free` | reported; valid until the next resume | the same run |
/// | `Lasting` | reported; kept for later resumes | the same run |
/// | `Reported` | reported; valid until the next resume | another figure |
/// | `Length` | reported; kept for later resumes | another run |
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Class {
    /// Changes the numbers of the steps.
    Numbers,
    /// Determines the layout of stored pages.
    Layout,
    /// Different values can have the same effect: for `schedule-steps` the resolved steps are compared, for `init-ply`
    /// and `pages-file` the digest of the first Gaussians, for `views-file` those of the views.
    Derived,
    /// The instruction path: as [`Class::Derived`]; results differ at most in rounding.
    Instructions,
    /// Location of the dataset, and whether it may be incomplete.
    Place,
    /// Resources, speed and outputs of a run.
    Free,
    /// As [`Class::Free`], for the place and the keeping of the checkpoint.
    Lasting,
    /// Changes a reported figure but no Gaussian.
    Reported,
    /// Number of steps. The learning rates follow `schedule-steps` instead.
    Length,
}

impl Class {
    /// Whether a run may resume with another value without --accept-changes, because no step computes other numbers.
    pub fn is_free(self) -> bool {
        matches!(self, Class::Free | Class::Lasting | Class::Reported | Class::Length)
    }

    /// Whether another value is kept for later resumes.
    pub fn lasts(self) -> bool {
        !matches!(self, Class::Free | Class::Reported)
    }

    /// Whether the derived value is compared instead of the key.
    pub fn is_derived(self) -> bool {
        matches!(self, Class::Derived | Class::Instructions)
    }

    /// Whether another value makes a run or its figures differ from a published run.
    pub fn makes_another_run(self) -> bool {
        !matches!(self, Class::Free | Class::Lasting | Class::Place | Class::Instructions)
    }
}

/// The text of configs/default.toml: every key with its meaning and default.
pub fn default_file() -> String {
    let defaults = toml::Table::try_from(TrainConfig::default()).unwrap_or_default();
    let mut text = String::from(
        "# Every key with its meaning and default. A config file needs only the keys that it changes;\n\
         # flags of the same name override it.\n",
    );
    let mut last_heading = "";
    for key in KEYS {
        if key.heading != last_heading {
            text.push_str(&format!("\n## {}\n", key.heading));
            last_heading = key.heading;
        }
        for line in key.meaning.lines() {
            text.push_str(&format!("\n#{line}"));
        }
        let name = key.name();
        let value = defaults.get(&name).map(ToString::to_string).unwrap_or_default();
        text.push_str(&format!("\n{name} = {value}\n"));
    }
    text
}

/// Facts of a run that follow from its config, scene and machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Resolved {
    pub version: String,
    /// Identity of the run; its commits hold it too. Unknown if somebody removed the line.
    #[serde(default)]
    pub run: RunId,
    pub scene: PathBuf,
    pub simd: String,
    pub threads: usize,
    /// The renderer: "cpu", or the name of the GPU with its driver.
    pub device: String,
    pub train_views: usize,
    pub test_views: usize,
    /// Gaussians at the start.
    pub gaussians: u64,
    /// Origin removed from the dataset's coordinates.
    pub origin: [f64; 3],
    /// Scale removed from the dataset's coordinates.
    pub scale: f64,
    /// Scene scale, dataset units.
    pub scene_scale: f64,
    /// The run made the folder of its spill directory, and so removes it at its end; not if the line is missing.
    #[serde(default)]
    pub made_spill_dir: bool,
}

/// Writes config.toml: every key, then the facts. Errors: the folder cannot be written.
pub fn write_config(path: &Path, config: &TrainConfig, resolved: &Resolved) -> InputResult<()> {
    let fail = |e: toml::ser::Error| InputError::new(path, format!("writing failed: {e}"), "report this as a bug");
    let mut text = toml::to_string(config).map_err(fail)?;
    text.push_str("\n[resolved]\n");
    text.push_str(&toml::to_string(resolved).map_err(fail)?);
    write_whole(path, text.as_bytes())
}

/// Reads the facts back from a run's config.toml. Errors: the file has no `[resolved]` table of a run.
pub fn read_resolved(path: &Path) -> InputResult<Resolved> {
    let text = read_text(path, FILE_BYTES_MAX, "name the output folder of a run")?;
    let refuse = |problem: String| InputError::new(path, problem, "name the output folder of a run");
    let mut table: toml::Table = text.parse().map_err(|e: toml::de::Error| refuse(e.to_string()))?;
    let resolved = table.remove("resolved").ok_or_else(|| refuse("it has no table [resolved]".to_string()))?;
    Resolved::deserialize(resolved).map_err(|e| refuse(e.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_keys_are_refused_with_their_line_and_a_similar_key() {
        let refusals = [
            ("steps = 3\n\nmax_gaussians = 5", "line 3: there is no key max_gaussians; perhaps max-gaussians is meant"),
            ("max-gausians = 5", "line 1: there is no key max-gausians; perhaps max-gaussians is meant"),
            ("iterations = 5", "line 1: there is no key iterations; perhaps steps is meant"),
            ("qq = 1", "line 1: there is no key qq"),
            ("max-gaussians = \"many\"", "line 1: max-gaussians: invalid type: string \"many\", expected u64"),
            ("threads = \"5000M\"", "line 1: threads: invalid type: string \"5000M\", expected u32"),
        ];
        for (text, want) in refusals {
            assert_eq!(TrainConfig::parse(text).unwrap_err(), want);
        }
    }

    #[test]
    fn counts_and_times_in_a_file_are_read_as_those_of_flags() {
        let text =
            "max-gaussians = \"2M\"\nsteps = \"7k\"\nhost-mem = \"4GiB\"\ncommit-every = \"5min\"\ndisk-full-wait = 30";
        let config = TrainConfig::parse(text).unwrap();
        assert_eq!((config.max_gaussians, config.steps), (2_000_000, 7000));
        assert_eq!((config.commit_every, config.disk_full_wait), (CommitEvery::Seconds(300.0), 30.0));
    }

    #[test]
    fn values_out_of_range_are_refused_by_name() {
        let good = TrainConfig::default;
        assert!(good().check().is_ok());
        for (bad, key) in [
            (TrainConfig { sh_degree: 4, ..good() }, "--sh-degree"),
            // As 32-bit numbers these are a half, 1, 0 and 1.
            (TrainConfig { prune_opa: 0.499_999_999, ..good() }, "--prune-opa"),
            (TrainConfig { init_opacity: 0.999_999_98, ..good() }, "--init-opacity"),
            (TrainConfig { init_opacity: 1e-60, ..good() }, "--init-opacity"),
            (TrainConfig { max_alpha: 0.999_999_98, ..good() }, "--max-alpha"),
        ] {
            assert!(bad.check().is_err_and(|e| e.to_string().contains(key)), "{key}");
        }
    }

    #[test]
    fn relocation_needs_a_cap_and_the_host() {
        let uncapped = TrainConfig { strategy: StrategyName::Mcmc, ..TrainConfig::default() };
        let refusal = uncapped.check().err().map(|e| e.to_string()).unwrap_or_default();
        assert!(refusal.contains("--strategy mcmc") && refusal.contains("give --max-gaussians"), "{refusal}");
        let capped = TrainConfig { max_gaussians: 1000, ..uncapped };
        assert!(capped.check().is_ok());
        let on_device = TrainConfig { optimizer_on: Chosen(Some(OptimizerPlace::Device)), ..capped };
        let refusal = on_device.check().err().map(|e| e.to_string()).unwrap_or_default();
        assert!(refusal.contains("leave out --strategy mcmc, or --optimizer-on host"), "{refusal}");
    }
}
