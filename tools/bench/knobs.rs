//! The knobs of a sweep and the settings that are tried of each.
//!
//! A setting differs from the base in its knob alone; `together` turns a few at once. Settings that are the base's, or
//! that the scene does not allow (too few frames, fewer Gaussians than there are), are left out.

use super::facts::Facts;
use super::sweep::Planned;
use gsscale::base::error::{InputError, InputResult};
use gsscale::config::choice::{Choice, Chosen};
use gsscale::config::file::TrainConfig;
use gsscale::optim::method::Method;
use gsscale::optim::moments::Moments;
use gsscale::page::format::codec::Codec;
use gsscale::schedule::order::Order;
use gsscale::train::error::TrainError;
use std::path::Path;

/// Names of all knobs, in the order in which they are tried.
pub const KNOBS: [&str; 11] =
    ["optimizer", "order", "budget", "page", "codec", "moments", "sh", "cap", "resolution", "steps", "together"];

/// Orders of views that are tried.
const ORDERS: [Order; 5] = [Order::Shuffle, Order::Groups(4), Order::Groups(9), Order::Groups(25), Order::Tour];
/// Frames that are tried, in percent of the pages.
const BUDGETS: [f64; 4] = [75.0, 50.0, 25.0, 10.0];
/// Share of the pages for knobs that do nothing in memory, where the base is in memory.
const DRIVE_SHARE: f64 = 50.0;

/// Changes some keys.
type Turn = fn(&mut TrainConfig);

/// What settings are made from.
pub struct Knobs<'a> {
    /// The scene.
    pub scene: &'a Path,
    /// The base, its order settled.
    pub base: &'a Planned,
    /// The scene at its start, with the pages of the base.
    pub facts: &'a Facts,
    /// Frames of the base in percent of the pages; 0 = all pages in memory.
    pub share: f64,
}

/// Checks the names of knobs.
///
/// # Errors
/// A name is not known.
pub fn check(names: &[String]) -> InputResult<()> {
    match names.iter().find(|n| !KNOBS.contains(&n.as_str())) {
        None => Ok(()),
        Some(name) => {
            let problem = format!("'{name}' is no knob");
            Err(InputError::new("--knobs", problem, format!("use some of: {}", KNOBS.join(","))))
        }
    }
}

impl Knobs<'_> {
    /// The settings of all named knobs, one of each knob first, then the second of each, and so on: a sweep that is cut
    /// short has tried every knob.
    ///
    /// # Errors
    /// The scene cannot be read with another page size.
    pub fn settings(&self, names: &[String]) -> Result<Vec<Planned>, TrainError> {
        let lists = names.iter().map(|name| self.of_knob(name)).collect::<Result<Vec<_>, _>>()?;
        let longest = lists.iter().map(Vec::len).max().unwrap_or(0);
        Ok((0..longest).flat_map(|i| lists.iter().filter_map(move |list| list.get(i).cloned())).collect())
    }

    fn of_knob(&self, knob: &str) -> Result<Vec<Planned>, TrainError> {
        let base = &self.base.config;
        Ok(match knob {
            "optimizer" => self.choices(knob, [Method::Sparse, Method::Dense], |c| &mut c.optimizer),
            "order" => self.choices(knob, ORDERS.map(|order| Chosen(Some(order))), |c| &mut c.view_order),
            "budget" => self.budgets(),
            "page" => return self.page_sizes(),
            "codec" => self.codecs(),
            "moments" => self.choices(knob, [Moments::Bf16], |c| &mut c.moments),
            "sh" => self.each(knob, ["2", "1", "0"], |c, degree| lower_sh(c, degree.parse().unwrap_or(0))),
            "cap" => self.caps(),
            "resolution" => self.each(knob, ["1/1.5", "1/2"], |c, text| {
                lower_resolution(c, text[2..].parse().unwrap_or(1.0));
            }),
            "steps" => self.each(knob, ["1/2", "x2"], |c, text| {
                c.steps = if text == "x2" { base.steps.saturating_mul(2) } else { base.steps.div_ceil(2) };
            }),
            _ => self.together(),
        })
    }

    /// One run for each value of a key but the base's.
    fn choices<T: Choice, const N: usize>(
        &self,
        knob: &str,
        values: [T; N],
        key: fn(&mut TrainConfig) -> &mut T,
    ) -> Vec<Planned> {
        let turned = values.map(|value| {
            let mut planned = self.named(knob, &value.word());
            *key(&mut planned.config) = value;
            planned
        });
        turned.into_iter().filter(|p| p.config != self.base.config).collect()
    }

    /// One run for each name, the base turned by `turn`; those that come to the base are left out.
    fn each<const N: usize>(
        &self,
        knob: &str,
        names: [&str; N],
        turn: impl Fn(&mut TrainConfig, &str),
    ) -> Vec<Planned> {
        let turned = names.map(|name| {
            let mut planned = self.named(knob, name);
            turn(&mut planned.config, name);
            planned
        });
        turned.into_iter().filter(|p| p.config != self.base.config).collect()
    }

    fn named(&self, knob: &str, label: &str) -> Planned {
        Planned { knob: knob.into(), label: label.into(), config: self.base.config.clone() }
    }

    fn budgets(&self) -> Vec<Planned> {
        let config = &self.base.config;
        let shares = BUDGETS.into_iter().filter_map(|p| Some((format!("{p} % of the pages"), self.facts.frames(p)?)));
        let mut all: Vec<Planned> =
            shares.map(|(label, frames)| self.named("budget", &label).on_drive(frames)).collect();
        // The fewest that hold a view, unless one of the shares is about that.
        let (frames, least) =
            (self.facts.fewest_frames(), all.last().map_or(self.facts.pages_at_end(), |p| p.config.frames.into()));
        if frames < self.facts.pages_at_end() && (all.is_empty() || frames * 5 < least * 4) {
            let percent = self.facts.percent(frames).round();
            all.push(self.named("budget", &format!("{percent} % of the pages")).on_drive(frames));
        }
        if self.share > 0.0 {
            let mut in_memory = self.named("budget", "in memory");
            (in_memory.config.spill_dir, in_memory.config.frames) = (String::new(), 0);
            all.insert(0, in_memory);
        }
        all.retain(|p| p.config != *config);
        all
    }

    /// Frames for runs of a knob that does nothing in memory, and how labels say so; `None` where a view needs all pages.
    fn drive(&self, facts: &Facts) -> Option<(u64, String)> {
        let share = if self.share > 0.0 { self.share } else { DRIVE_SHARE };
        let frames = facts.frames(share).unwrap_or_else(|| facts.fewest_frames());
        let percent = facts.percent(frames).round();
        let label = if self.share > 0.0 { String::new() } else { format!(", {percent} % of the pages") };
        (frames < facts.pages_at_end()).then_some((frames, label))
    }

    fn codecs(&self) -> Vec<Planned> {
        let Some((frames, at)) = self.drive(self.facts) else { return Vec::new() };
        let codec = |codec: Codec| {
            let mut planned = self.named("codec", &format!("{codec}{at}")).on_drive(frames);
            planned.config.spill_codec = Chosen(Some(codec));
            planned
        };
        let mut all = vec![codec(Codec::Raw), codec(Codec::Zstd { level: 1 })];
        let mut halves = codec(Codec::Halves);
        halves.label = format!("bf16 moments, halves{at}");
        halves.config.moments = Moments::Bf16;
        all.push(halves);
        all.retain(|p| p.config != self.base.config);
        all
    }

    /// Pages of other sizes, with as many bytes of frames as the codecs have, or what the largest view needs of them.
    fn page_sizes(&self) -> Result<Vec<Planned>, TrainError> {
        let (own, mut all) = (self.base.config.page_rows, Vec::new());
        let Some((own_frames, _)) = self.drive(self.facts) else { return Ok(all) };
        for rows in [own / 4, own.saturating_mul(4)] {
            let mut planned = self.named("page", "");
            planned.config.page_rows = rows;
            if planned.config.check().is_err() {
                continue;
            }
            let facts = Facts::of(self.scene, &planned.config)?;
            let frames = (own_frames * u64::from(own)).div_ceil(u64::from(rows)).max(facts.fewest_frames());
            if frames < facts.pages_at_end() {
                planned.label = format!("{rows} rows, {:.0} % of the pages", facts.percent(frames));
                all.push(planned.on_drive(frames));
            }
        }
        Ok(all)
    }

    fn caps(&self) -> Vec<Planned> {
        let (config, start) = (&self.base.config, self.facts.gaussians);
        if !config.strategy.grows() {
            return Vec::new();
        }
        let caps = match config.max_gaussians {
            0 => [start * 3 / 2, start * 3, start * 6],
            cap => [cap / 2, cap / 4 * 3, cap.saturating_mul(2)],
        };
        let cap = |n: u64| {
            let mut planned = self.named("cap", &n.to_string());
            planned.config.max_gaussians = n;
            planned
        };
        caps.into_iter().filter(|n| *n > start).map(cap).collect()
    }

    fn together(&self) -> Vec<Planned> {
        let base = &self.base.config;
        let turns: [(&str, Turn); 3] = [
            ("SH 1 and bf16 moments", |c| {
                lower_sh(c, 1);
                c.moments = Moments::Bf16;
            }),
            ("half the steps at 1/1.5 of the resolution", |c| {
                c.steps = c.steps.div_ceil(2);
                lower_resolution(c, 1.5);
            }),
            ("SH 1 and the sparse optimizer", |c| {
                lower_sh(c, 1);
                c.optimizer = Method::Sparse;
            }),
        ];
        let turned = turns.map(|(label, turn)| {
            let mut planned = self.named("together", label);
            turn(&mut planned.config);
            planned
        });
        turned.into_iter().filter(|p| p.config != *base).collect()
    }
}

/// Photos smaller by `factor`, whichever of the two keys it is that bounds them.
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
