//! The knobs of a sweep and the settings of each knob.
//!
//! A setting differs from the base in one knob; `together` changes several. Settings equal to the base are dropped, and
//! so are settings that the scene does not allow (too few frames, a cap below the initial number of Gaussians).

use super::facts::Facts;
use super::sweep::{Planned, use_drive};
use gsscale::config::choice::{Choice, Chosen};
use gsscale::config::file::TrainConfig;
use gsscale::optim::method::Method;
use gsscale::optim::moments::Moments;
use gsscale::page::format::codec::Codec;
use gsscale::schedule::order::Order;
use gsscale::train::error::TrainError;
use std::path::Path;

/// Names of all knobs, in the order of a sweep.
pub const KNOBS: [&str; 11] =
    ["optimizer", "order", "budget", "page", "codec", "moments", "sh", "cap", "resolution", "steps", "together"];

const ORDERS: [Order; 5] = [Order::Shuffle, Order::Groups(4), Order::Groups(9), Order::Groups(25), Order::Tour];
/// Numbers of frames, in percent of the pages.
const BUDGETS: [f64; 4] = [75.0, 50.0, 25.0, 10.0];
/// Frames in percent of the pages for knobs that need a drive, if the base is in memory.
const DRIVE_SHARE: f64 = 50.0;

/// The input of the settings.
pub struct Knobs<'a> {
    pub scene: &'a Path,
    /// The base, with a resolved order of views.
    pub base: &'a TrainConfig,
    /// The scene at the start, with the pages of the base.
    pub facts: &'a Facts,
    /// Frames of the base in percent of the pages; 0 = all pages in memory.
    pub share: f64,
}

impl Knobs<'_> {
    /// The settings of the named knobs: the first setting of each knob, then the second of each, and so on. A sweep
    /// that stops early has then tried every knob.
    ///
    /// # Errors
    /// The scene cannot be read with another page size.
    pub fn settings(&self, names: &[String]) -> Result<Vec<Planned>, TrainError> {
        let lists = names.iter().map(|name| self.of_knob(name)).collect::<Result<Vec<_>, _>>()?;
        let longest = lists.iter().map(Vec::len).max().unwrap_or(0);
        Ok((0..longest).flat_map(|i| lists.iter().filter_map(move |list| list.get(i).cloned())).collect())
    }

    fn of_knob(&self, knob: &str) -> Result<Vec<Planned>, TrainError> {
        let steps = self.base.steps;
        Ok(match knob {
            "optimizer" => self.choices(knob, [Method::Sparse, Method::Dense], |c| &mut c.optimizer),
            "order" => self.choices(knob, ORDERS.map(|order| Chosen(Some(order))), |c| &mut c.view_order),
            "budget" => self.budgets(),
            "page" => return self.page_sizes(),
            "codec" => self.codecs(),
            "moments" => self.choices(knob, [Moments::Bf16], |c| &mut c.moments),
            "sh" => self.each([2, 1, 0], |degree| self.changed(knob, degree.to_string(), |c| lower_sh(c, degree))),
            "cap" => self.caps(),
            "resolution" => self
                .each([1.5, 2.0], |factor| self.changed(knob, format!("1/{factor}"), |c| lower_resolution(c, factor))),
            "steps" => self.each([("1/2", steps.div_ceil(2)), ("x2", steps.saturating_mul(2))], |(label, steps)| {
                self.changed(knob, label, |c| c.steps = steps)
            }),
            _ => self.together(),
        })
    }

    /// The base with one change; `None` if the result equals the base.
    fn changed(&self, knob: &str, label: impl Into<String>, change: impl FnOnce(&mut TrainConfig)) -> Option<Planned> {
        let mut config = self.base.clone();
        change(&mut config);
        (config != *self.base).then(|| Planned::new(knob, label, config))
    }

    fn each<T, const N: usize>(&self, values: [T; N], setting: impl Fn(T) -> Option<Planned>) -> Vec<Planned> {
        values.into_iter().filter_map(setting).collect()
    }

    /// One setting for each value of a key.
    fn choices<T: Choice, const N: usize>(
        &self,
        knob: &str,
        values: [T; N],
        key: fn(&mut TrainConfig) -> &mut T,
    ) -> Vec<Planned> {
        self.each(values, |value| self.changed(knob, value.word().into_owned(), |c| *key(c) = value))
    }

    fn budgets(&self) -> Vec<Planned> {
        let mut shares: Vec<(f64, u64)> =
            BUDGETS.into_iter().filter_map(|percent| Some((percent, self.facts.frames(percent)?))).collect();
        // The fewest frames that hold a view, unless the smallest share is close to that.
        let fewest = self.facts.fewest_frames();
        if fewest < self.facts.pages_at_end() && shares.last().is_none_or(|(_, frames)| fewest * 5 < frames * 4) {
            shares.push((self.facts.percent(fewest).round(), fewest));
        }
        let in_memory = self.changed("budget", "in memory", |c| (c.spill_dir, c.frames) = (String::new(), 0));
        let shares = shares.into_iter().filter_map(|(percent, frames)| {
            self.changed("budget", format!("{percent} % of the pages"), |c| use_drive(c, frames))
        });
        in_memory.into_iter().chain(shares).collect()
    }

    /// Frames for knobs that need a drive, and their part of the label; `None` if a view needs all pages.
    fn drive(&self, facts: &Facts) -> Option<(u64, String)> {
        let share = if self.share > 0.0 { self.share } else { DRIVE_SHARE };
        let frames = facts.frames(share).unwrap_or_else(|| facts.fewest_frames());
        let percent = facts.percent(frames).round();
        let label = if self.share > 0.0 { String::new() } else { format!(", {percent} % of the pages") };
        (frames < facts.pages_at_end()).then_some((frames, label))
    }

    fn codecs(&self) -> Vec<Planned> {
        let Some((frames, at)) = self.drive(self.facts) else { return Vec::new() };
        let own = self.base.moments;
        let codecs = [
            ("", Codec::Raw, own),
            ("", Codec::Zstd { level: 1 }, own),
            ("bf16 moments, ", Codec::Halves, Moments::Bf16),
        ];
        self.each(codecs, |(prefix, codec, moments)| {
            self.changed("codec", format!("{prefix}{codec}{at}"), |c| {
                use_drive(c, frames);
                (c.spill_codec, c.moments) = (Chosen(Some(codec)), moments);
            })
        })
    }

    /// Other page sizes, with the same bytes of frames as the codecs, or the frames that the largest view needs.
    fn page_sizes(&self) -> Result<Vec<Planned>, TrainError> {
        let (own, mut all) = (self.base.page_rows, Vec::new());
        let Some((own_frames, _)) = self.drive(self.facts) else { return Ok(all) };
        for rows in [own / 4, own.saturating_mul(4)] {
            let config = TrainConfig { page_rows: rows, ..self.base.clone() };
            if config.check().is_err() {
                continue;
            }
            let facts = Facts::of(self.scene, &config)?;
            let frames = (own_frames * u64::from(own)).div_ceil(u64::from(rows)).max(facts.fewest_frames());
            if frames < facts.pages_at_end() {
                let label = format!("{rows} rows, {:.0} % of the pages", facts.percent(frames));
                all.extend(self.changed("page", label, |c| {
                    c.page_rows = rows;
                    use_drive(c, frames);
                }));
            }
        }
        Ok(all)
    }

    fn caps(&self) -> Vec<Planned> {
        let start = self.facts.gaussians;
        if !self.base.strategy.grows() {
            return Vec::new();
        }
        let caps = match self.base.max_gaussians {
            0 => [start * 3 / 2, start * 3, start * 6],
            cap => [cap / 2, cap / 4 * 3, cap.saturating_mul(2)],
        };
        self.each(caps, |cap| self.changed("cap", cap.to_string(), |c| c.max_gaussians = cap).filter(|_| cap > start))
    }

    fn together(&self) -> Vec<Planned> {
        let sh_and_moments = self.changed("together", "SH 1 and bf16 moments", |c| {
            lower_sh(c, 1);
            c.moments = Moments::Bf16;
        });
        let steps_and_resolution = self.changed("together", "half the steps at 1/1.5 of the resolution", |c| {
            c.steps = c.steps.div_ceil(2);
            lower_resolution(c, 1.5);
        });
        let sh_and_optimizer = self.changed("together", "SH 1 and the sparse optimizer", |c| {
            lower_sh(c, 1);
            c.optimizer = Method::Sparse;
        });
        [sh_and_moments, steps_and_resolution, sh_and_optimizer].into_iter().flatten().collect()
    }
}

/// Divides the resolution of photos by `factor`, through both keys that limit it.
fn lower_resolution(config: &mut TrainConfig, factor: f64) {
    config.data_factor *= factor;
    if config.max_resolution > 0 {
        config.max_resolution = (f64::from(config.max_resolution) / factor).round().max(1.0) as u32;
    }
}

fn lower_sh(config: &mut TrainConfig, degree: u8) {
    config.sh_degree = config.sh_degree.min(degree);
    config.sh_start = config.sh_start.min(degree);
}
