//! Predicts the transfers of `--optimizer-on device` over a bus: replays the slots of a device like the frames of a cache, and prints the
//! milliseconds of a step by part.
//!
//! The figures are modelled, not measured: a copy takes the latency plus its bytes over the rate, payloads move while the GPU works, and
//! everything else does not. The GPU's own time comes from a flag or from the timed
//! steps.
//!
//! Not here: frames and the drive.

use gsscale::base::units::format_bytes;
use gsscale::gpu::EmulatedBus;
use gsscale::paging::simulation::replay::{Figures, Replay};
use gsscale::schedule::order::Order;
use serde_json::{Value, json};

/// Bytes of tables and uniforms that a step uploads, about, and the copies that they take.
const TABLES: (f64, f64) = (50e3, 4.0);
/// Bytes a page that a step reads back (counts of listed rows, results), and the copies of a step: those, the two sizes of the lists, the
/// loss, and the count of unusable rows.
const RESULTS: (f64, f64) = (56.0, 6.0);

/// The device and its bus.
#[derive(Debug, Clone, Copy)]
pub struct DeviceModel {
    pub bus: EmulatedBus,
    /// Slots of the device.
    pub slots: usize,
    /// Bytes of a slot.
    pub slot_bytes: u64,
    /// Mean bytes of a payload.
    pub payload: f64,
    /// Mean pixels of a photo.
    pub pixels: f64,
    /// Seconds that the GPU works on a step.
    pub gpu_seconds: f64,
}

/// A step by part, seconds.
#[derive(Debug, Clone, Copy)]
pub struct StepParts {
    /// Photo, tables and uniforms, up.
    pub photo: f64,
    /// Payloads that the device lacks, up.
    pub payloads_up: f64,
    /// Payloads that leave their slots, down.
    pub payloads_down: f64,
    /// Results, down.
    pub results: f64,
    /// The GPU's own work.
    pub gpu: f64,
}

impl StepParts {
    /// The parts of a step of a replay.
    pub fn of(model: &DeviceModel, figures: &Figures) -> StepParts {
        let time =
            |bytes: f64, copies: f64| copies * model.bus.latency.as_secs_f64() + bytes / model.bus.bytes_per_second;
        let pages = |bytes: f64| bytes / model.payload.max(1.0);
        StepParts {
            photo: time(4.0 * model.pixels + TABLES.0, 1.0 + TABLES.1),
            payloads_up: time(figures.read_per_step, pages(figures.read_per_step)),
            payloads_down: time(figures.written_per_step, pages(figures.written_per_step)),
            results: time(RESULTS.0 * figures.pages_per_step, RESULTS.1),
            gpu: model.gpu_seconds,
        }
    }

    /// A step whose payloads move while the GPU works.
    pub fn beside(&self) -> f64 {
        self.photo + self.results + self.gpu.max(self.payloads_up + self.payloads_down)
    }

    /// A step that does one thing after the other.
    pub fn in_turn(&self) -> f64 {
        self.photo + self.results + self.gpu + self.payloads_up + self.payloads_down
    }
}

/// A replay of the slots under a view order.
pub struct DeviceRow {
    /// The order of views.
    pub order: Order,
    pub model: DeviceModel,
    /// What the steps after the first epoch move, where pages of a step and of the next one lie in slots at a time.
    pub figures: Figures,
    /// Bytes that go up in a mean step where pages come when they are needed: no cache of that size moves fewer.
    pub fewest: f64,
    /// A mean step.
    pub parts: StepParts,
}

impl DeviceRow {
    /// The row of two replays of payloads in slots: copied a step ahead, and when they are needed.
    pub fn new(order: Order, model: DeviceModel, [ahead, on_demand]: [&Replay; 2]) -> DeviceRow {
        let figures = ahead.figures(ahead.steady());
        let fewest = on_demand.figures(on_demand.steady()).read_per_step;
        DeviceRow { order, model, figures, fewest, parts: StepParts::of(&model, &figures) }
    }

    /// The row as JSON.
    pub fn json(&self) -> Value {
        let (parts, ms) = (&self.parts, |seconds: f64| 1e3 * seconds);
        json!({
            "view_order": self.order.to_string(), "slots": self.model.slots, "slot_bytes": self.model.slot_bytes,
            "hit_rate": self.figures.hit_rate, "bytes_up_per_step": self.figures.read_per_step,
            "bytes_down_per_step": self.figures.written_per_step, "fewest_bytes_up_per_step": self.fewest, "photo_ms": ms(parts.photo),
            "payloads_up_ms": ms(parts.payloads_up), "payloads_down_ms": ms(parts.payloads_down),
            "results_ms": ms(parts.results), "gpu_ms": ms(parts.gpu), "step_ms": ms(parts.beside()),
            "step_in_turn_ms": ms(parts.in_turn()), "is_modelled": true,
        })
    }
}

/// The table of the rows.
pub fn report(rows: &[DeviceRow]) -> String {
    let Some(first) = rows.first() else { return String::new() };
    let bus = first.model.bus;
    let mut text = format!(
        "\npages on the device, modelled: a bus of {}/s and {:.0} us a copy, milliseconds a step\n\
         {:12} {:>14} {:>9} {:>10} {:>10} {:>10} {:>8} {:>8} {:>8} {:>8} {:>8} {:>8} {:>8}",
        format_bytes(bus.bytes_per_second as u64),
        1e6 * bus.latency.as_secs_f64(),
        "order",
        "slots",
        "hit rate",
        "fewest",
        "up/step",
        "down/step",
        "photo",
        "up",
        "down",
        "results",
        "GPU",
        "beside",
        "in turn",
    );
    for row in rows {
        let (p, ms) = (&row.parts, |seconds: f64| 1e3 * seconds);
        let slots = format!("{} {}", row.model.slots, format_bytes(row.model.slots as u64 * row.model.slot_bytes));
        text += &format!(
            "\n{:12} {slots:>14} {:>9.3} {:>10} {:>10} {:>10} {:>8.2} {:>8.2} {:>8.2} {:>8.2} {:>8.2} {:>8.2} {:>8.2}",
            row.order.to_string(),
            row.figures.hit_rate,
            format_bytes(row.fewest as u64),
            format_bytes(row.figures.read_per_step as u64),
            format_bytes(row.figures.written_per_step as u64),
            ms(p.photo),
            ms(p.payloads_up),
            ms(p.payloads_down),
            ms(p.results),
            ms(p.gpu),
            ms(p.beside()),
            ms(p.in_turn()),
        );
    }
    text + "\nfewest   bytes up where pages come when they are needed; up/step: a step ahead, with pages of two steps in slots\
            \nbeside   payloads move while the GPU works; in turn: one thing after the other\
            \nGPU      --step-seconds, or the timed steps: the time of another GPU is to be given"
}
