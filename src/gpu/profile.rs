//! Time of every stage on the device, from timestamps around its compute passes.
//!
//! Invariants: (1) without timestamps on the adapter, or with profiling off, nothing is recorded and the list is empty:
//! no figure is estimated; (2) a pass is limited to dispatches of one stage only while profiling.

use std::sync::Arc;

use super::buffers::BufferView;
use super::driver::Driver;
use super::error::GpuResult;
use super::readback::{Readback, Staging};
use super::submitter::{Mapping, Ticket};

/// Most passes of one recorder that are timed; further ones are not.
const PASSES_MAX: u32 = 1024;

/// Time of one stage since the device was opened.
#[derive(Debug, Clone, PartialEq)]
pub struct StageTime {
    pub stage: &'static str,
    /// Number of timed passes.
    pub passes: u64,
    /// Their total time, seconds.
    pub seconds: f64,
}

/// Timestamps in flight, and the sums of those read back.
#[derive(Debug)]
pub(super) struct Profiler {
    staging: Arc<Staging>,
    queries: Option<(wgpu::QuerySet, wgpu::Buffer)>,
    seconds_per_tick: f64,
    recorded: Vec<&'static str>,
    under_way: Vec<(Readback, Vec<&'static str>)>,
    sums: Vec<StageTime>,
}

impl Profiler {
    pub(super) fn new(driver: &Driver, staging: Arc<Staging>, on: bool) -> Profiler {
        let queries = on.then(|| {
            let set = driver.device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("stage times"),
                ty: wgpu::QueryType::Timestamp,
                count: 2 * PASSES_MAX,
            });
            let usage = wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC;
            (set, driver.buffer("stage times", u64::from(2 * PASSES_MAX) * 8, usage))
        });
        Profiler {
            staging,
            queries,
            seconds_per_tick: if on { f64::from(driver.timestamp_period) * 1e-9 } else { 0.0 },
            recorded: Vec::new(),
            under_way: Vec::new(),
            sums: Vec::new(),
        }
    }

    pub(super) fn is_on(&self) -> bool {
        self.queries.is_some()
    }

    /// Begins a pass for `stage`, timed while there is room.
    pub(super) fn begin_pass(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        stage: &'static str,
    ) -> wgpu::ComputePass<'static> {
        let at = u32::try_from(self.recorded.len()).unwrap_or(PASSES_MAX);
        let writes =
            self.queries.as_ref().filter(|_| at < PASSES_MAX).map(|(set, _)| wgpu::ComputePassTimestampWrites {
                query_set: set,
                beginning_of_pass_write_index: Some(2 * at),
                end_of_pass_write_index: Some(2 * at + 1),
            });
        let timed = writes.is_some();
        let pass = encoder
            .begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some(stage), timestamp_writes: writes })
            .forget_lifetime();
        if timed {
            self.recorded.push(stage);
        }
        pass
    }

    /// Records the read-back of this submission's timestamps.
    pub(super) fn resolve(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        ticket: &Ticket,
    ) -> GpuResult<Option<Mapping>> {
        let Some((set, resolved)) = &self.queries else { return Ok(None) };
        if self.recorded.is_empty() {
            return Ok(None);
        }
        let stages = std::mem::take(&mut self.recorded);
        let count = 2 * u32::try_from(stages.len()).unwrap_or(PASSES_MAX);
        encoder.resolve_query_set(set, 0..count, resolved, 0);
        let view = BufferView { raw: resolved.clone(), label: "stage times", offset: 0, size: u64::from(count) * 8 };
        let (readback, pending) = self.staging.record(encoder, "stage times", &view, ticket, None)?;
        self.under_way.push((readback, stages));
        Ok(Some(pending))
    }

    /// Adds timestamps in flight to the sums, waiting for all but the last `leave` submissions.
    pub(super) fn collect(&mut self, leave: usize) -> GpuResult<()> {
        while self.under_way.len() > leave {
            let (readback, stages) = self.under_way.remove(0);
            let ticks: Vec<u64> = readback.to_vec()?;
            for (stage, pair) in stages.into_iter().zip(ticks.chunks_exact(2)) {
                let seconds = pair[1].saturating_sub(pair[0]) as f64 * self.seconds_per_tick;
                match self.sums.iter_mut().find(|s| s.stage == stage) {
                    Some(sum) => {
                        sum.passes += 1;
                        sum.seconds += seconds;
                    }
                    None => self.sums.push(StageTime { stage, passes: 1, seconds }),
                }
            }
        }
        Ok(())
    }

    /// Time of every stage so far, in order of first use. Waits for the device.
    pub(super) fn times(&mut self) -> GpuResult<Vec<StageTime>> {
        self.collect(0)?;
        Ok(self.sums.clone())
    }
}
