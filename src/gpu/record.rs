//! Records work: uploads, dispatches, copies and read-backs in the order in which they run.
//!
//! Invariants: (1) bindings of a dispatch are checked here, so that an error names the stage and the variable, and
//! nothing is submitted after an error; (2) commands run in the order recorded, also across submissions; (3) when
//! uploads fill a staging set, the commands recorded so far are submitted and recording continues.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use super::adapter::GROUPS_MAX;
use super::belt::UNIFORM_CHUNK;
use super::buffers::{Buffer, BufferView};
use super::device::Gpu;
use super::error::{GpuError, GpuResult};
use super::faults::lock;
use super::injected::{FaultKind, fill_device};
use super::readback::Readback;
use super::shader::{BindingKind, Pipeline};
use super::submission_count::SubmissionCount;
use super::submitter::{Job, Mapping, Ticket, Waker};
use crate::base::trace;

/// Workgroups for `count` invocations in workgroups of `workgroup`, folded into two dimensions beyond 65,535.
///
/// The shader computes its index with `linear_group` or `linear_index` of `shared/dispatch.wgsl`, and ignores indices
/// at or beyond its count. Indices stay within 32 bits for counts up to 2^32 - 2^24.
pub fn groups_1d(count: u32, workgroup: u32) -> [u32; 3] {
    let groups = count.div_ceil(workgroup.max(1));
    if groups <= GROUPS_MAX {
        return [groups, 1, 1];
    }
    let rows = groups.div_ceil(GROUPS_MAX);
    [groups.div_ceil(rows), rows, 1]
}

/// A submission that can be waited for.
#[derive(Debug, Clone)]
pub struct Submission {
    ticket: Ticket,
    name: &'static str,
}

/// The unsubmitted work of a recorder, set aside between two calls of its owner; [`Gpu::resume`] continues it. Until
/// then it counts as an open recorder, and no other recorder can be submitted.
#[derive(Debug)]
#[must_use]
pub struct Recording {
    name: &'static str,
    encoder: wgpu::CommandEncoder,
    pass: Option<(wgpu::ComputePass<'static>, &'static str)>,
    uniforms: Vec<Vec<u8>>,
    readbacks: Vec<Mapping>,
    /// Of the submission that the commands will be part of.
    ticket: Ticket,
    _open: Arc<()>,
}

/// A recording of work.
pub struct Recorder<'g> {
    gpu: &'g Gpu,
    work: Recording,
}

impl Gpu {
    /// Starts a recording; `name` appears in errors that belong to no stage.
    pub fn begin(&self, name: &'static str) -> Recorder<'_> {
        let encoder = self.driver.encoder(name);
        let work = Recording {
            name,
            encoder,
            pass: None,
            uniforms: Vec::new(),
            readbacks: Vec::new(),
            ticket: Ticket::default(),
            _open: Arc::clone(&self.recordings),
        };
        Recorder { gpu: self, work }
    }

    /// Continues a recording of this device that was set aside.
    pub fn resume(&self, recording: Recording) -> Recorder<'_> {
        Recorder { gpu: self, work: recording }
    }

    /// Submits without waiting, unless [`super::GpuOptions::serial`] is set.
    /// Errors: the API refused the commands, the device was lost or ran out of memory, or two recorders were open at once.
    pub fn submit(&self, mut recorder: Recorder<'_>) -> GpuResult<Submission> {
        recorder.flush()
    }

    /// Waits until the device has finished a submission.
    /// Errors: the device was lost or ran out of memory.
    pub fn wait(&self, submission: &Submission) -> GpuResult<()> {
        self.driver.faults.set_stage(submission.name);
        self.driver.wait(submission.name, Some(&submission.ticket))
    }
}

impl Recorder<'_> {
    /// Sets the work aside without submitting it.
    pub fn set_aside(self) -> Recording {
        self.work
    }

    /// Uploads a uniform struct for dispatches of this recorder; binds as binding 0.
    /// Errors: the device has no memory left.
    pub fn uniform<T: bytemuck::NoUninit>(&mut self, value: &T) -> GpuResult<BufferView> {
        lock(&self.gpu.uniforms).pack(&mut self.work.uniforms, bytemuck::bytes_of(value))
    }

    /// Submits the commands recorded so far and goes on recording. Systems reset a device that works for seconds on one submission.
    /// Errors: as [`Gpu::submit`].
    pub fn submit_so_far(&mut self) -> GpuResult<()> {
        self.flush().map(|_| ())
    }

    /// A new buffer containing `data`.
    /// Errors: as [`Gpu::buffer`] and [`Recorder::upload`].
    pub fn buffer_with<T: bytemuck::NoUninit>(&mut self, label: &'static str, data: &[T]) -> GpuResult<Buffer> {
        let buffer = self.gpu.buffer(label, size_of_val(data) as u64)?;
        self.upload(&buffer.view(), data)?;
        Ok(buffer)
    }

    /// A new zeroed buffer.
    /// Errors: as [`Gpu::buffer`].
    pub fn buffer_zeroed(&mut self, label: &'static str, size: u64) -> GpuResult<Buffer> {
        let buffer = self.gpu.buffer(label, size)?;
        self.clear(&buffer.view())?;
        Ok(buffer)
    }

    /// Uploads `data` to the start of `view`; the last word is padded with zero bytes.
    /// Errors: the data is longer than the view, or the device failed.
    pub fn upload<T: bytemuck::NoUninit>(&mut self, view: &BufferView, data: &[T]) -> GpuResult<()> {
        let bytes = bytemuck::cast_slice::<T, u8>(data);
        if bytes.is_empty() {
            return Ok(());
        }
        self.check_copy("upload", view, (bytes.len() as u64).next_multiple_of(4))?;
        let (whole, rest) = bytes.split_at(bytes.len() / 4 * 4);
        self.upload_words(view, 0, whole)?;
        if !rest.is_empty() {
            let mut word = [0u8; 4];
            word[..rest.len()].copy_from_slice(rest);
            self.upload_words(view, whole.len() as u64, &word)?;
        }
        Ok(())
    }

    fn upload_words(&mut self, view: &BufferView, mut at: u64, mut bytes: &[u8]) -> GpuResult<()> {
        let _span = trace::span("upload").of("what", view.label).with("bytes", bytes.len() as u64);
        self.work.pass = None;
        self.gpu.driver.faults.set_stage(view.label);
        self.gpu.uploaded.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        while !bytes.is_empty() {
            let mut belt = lock(&self.gpu.belt);
            let done = belt.write(&mut self.work.encoder, &view.raw, view.offset + at, bytes)?;
            drop(belt);
            bytes = &bytes[done..];
            at += done as u64;
            if !bytes.is_empty() {
                self.flush()?; // the staging set is full
            }
        }
        Ok(())
    }

    /// Zeroes `view`.
    /// Errors: the view is not aligned to 4 bytes.
    pub fn clear(&mut self, view: &BufferView) -> GpuResult<()> {
        self.check_copy("clear", view, view.size)?;
        self.work.pass = None;
        self.gpu.driver.faults.set_stage(view.label);
        self.work.encoder.clear_buffer(&view.raw, view.offset, Some(view.size));
        Ok(())
    }

    /// Copies `from` to the start of `to`, which is another buffer.
    /// Errors: `to` is shorter, both are in one buffer, or one is not aligned to 4 bytes.
    pub fn copy(&mut self, from: &BufferView, to: &BufferView) -> GpuResult<()> {
        self.check_copy("copy", from, from.size)?;
        self.check_copy("copy", to, from.size)?;
        if from.raw == to.raw {
            return Err(GpuError::bindings(self.work.name, format!("a copy of {} within one buffer", from.label)));
        }
        self.work.pass = None;
        self.gpu.driver.faults.set_stage(to.label);
        self.work.encoder.copy_buffer_to_buffer(&from.raw, from.offset, &to.raw, to.offset, from.size);
        Ok(())
    }

    /// Records the read-back of `view` as it is at this point.
    /// Errors: the view is not aligned to 4 bytes, or there is no memory for staging.
    pub fn read_back(&mut self, stage: &'static str, view: &BufferView) -> GpuResult<Readback> {
        self.check_copy("read_back", view, view.size)?;
        self.work.pass = None;
        self.gpu.driver.faults.set_stage(stage);
        // No other recorder is submitted before this one.
        let count = self.gpu.submission_count.as_ref().map(SubmissionCount::expected);
        let (encoder, ticket) = (&mut self.work.encoder, &self.work.ticket);
        let (readback, pending) = self.gpu.staging.record(encoder, stage, view, ticket, count)?;
        self.work.readbacks.push(pending);
        Ok(readback)
    }

    /// Dispatches a stage; `views` are in the order of the binding numbers that its entry point uses. Zero groups do
    /// nothing.
    /// Errors: a view does not match its binding; the message names the stage and the variable.
    pub fn dispatch(
        &mut self,
        stage: &'static str,
        pipeline: &Pipeline,
        views: &[BufferView],
        groups: [u32; 3],
    ) -> GpuResult<()> {
        if groups.contains(&0) {
            return Ok(());
        }
        if groups.iter().any(|&n| n > GROUPS_MAX) {
            let problem = format!("{groups:?} workgroups; a dimension holds at most {GROUPS_MAX}");
            return Err(GpuError::bindings(stage, problem));
        }
        self.bind(stage, pipeline, views)?.dispatch_workgroups(groups[0], groups[1], groups[2]);
        let storage = pipeline.reflection.bindings.iter().zip(views).filter(|(b, _)| b.kind != BindingKind::Uniform);
        let mut work = lock(&self.gpu.work);
        work.dispatches += 1;
        work.workgroups += groups.map(u64::from).iter().product::<u64>();
        work.bytes_bound += storage.map(|(_, view)| view.size).sum::<u64>();
        self.gpu.driver.faults.check()
    }

    /// A pass with pipeline and bind group set.
    fn bind(
        &mut self,
        stage: &'static str,
        pipeline: &Pipeline,
        views: &[BufferView],
    ) -> GpuResult<&mut wgpu::ComputePass<'static>> {
        self.check_bindings(stage, pipeline, views)?;
        self.gpu.driver.faults.set_stage(stage);
        let entries: Vec<wgpu::BindGroupEntry<'_>> = pipeline
            .reflection
            .bindings
            .iter()
            .zip(views)
            .map(|(binding, view)| wgpu::BindGroupEntry {
                binding: binding.number,
                resource: wgpu::BindingResource::Buffer(wgpu::BufferBinding {
                    buffer: &view.raw,
                    offset: view.offset,
                    size: wgpu::BufferSize::new(view.size),
                }),
            })
            .collect();
        let group = self.gpu.driver.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(stage),
            layout: &pipeline.layout,
            entries: &entries,
        });
        self.gpu.driver.faults.check()?;
        let mut profiler = lock(&self.gpu.profiler);
        let reusable = self.work.pass.take_if(|(_, of)| !profiler.is_on() || *of == stage);
        let pass = match reusable {
            Some((pass, _)) => pass,
            None => {
                self.work.pass = None; // ends the previous stage's pass
                profiler.begin_pass(&mut self.work.encoder, stage)
            }
        };
        let (pass, _) = self.work.pass.insert((pass, stage));
        pass.set_pipeline(&pipeline.raw);
        pass.set_bind_group(0, &group, &[]);
        Ok(pass)
    }

    fn check_bindings(&self, stage: &'static str, pipeline: &Pipeline, views: &[BufferView]) -> GpuResult<()> {
        let problem = |problem: String| Err(GpuError::bindings(stage, problem));
        let bindings = &pipeline.reflection.bindings;
        if bindings.len() != views.len() {
            let names: Vec<&str> = bindings.iter().map(|b| b.name.as_str()).collect();
            return problem(format!("{} views were given for the bindings {}", views.len(), names.join(", ")));
        }
        for (i, (binding, view)) in bindings.iter().zip(views).enumerate() {
            let name = &binding.name;
            if view.size < binding.min_size {
                return problem(format!("{name} spans {} bytes, the shader needs {}", view.size, binding.min_size));
            }
            if !view.is_inside() {
                return problem(format!("{name} would span bytes beyond the end of {}", view.label));
            }
            if binding.kind == BindingKind::Uniform {
                continue;
            }
            self.gpu.check_binding(stage, name, view.size)?;
            if view.offset % self.gpu.offset_alignment() != 0 {
                let alignment = self.gpu.offset_alignment();
                return problem(format!("{name} begins at byte {}, not a multiple of {alignment}", view.offset));
            }
            for (other, other_view) in bindings.iter().zip(views).take(i) {
                if other_view.raw == view.raw && other.kind != binding.kind {
                    return problem(format!("{name} and {} are one buffer, one read and one written", other.name));
                }
            }
        }
        Ok(())
    }

    /// Checks that `size` bytes fit at the start of `view`, aligned to 4.
    fn check_copy(&self, what: &str, view: &BufferView, size: u64) -> GpuResult<()> {
        let problem = if !view.is_inside() {
            format!("{what}: a range beyond the end of {}", view.label)
        } else if size > view.size {
            format!("{what}: {size} bytes do not fit the {} of {}", view.size, view.label)
        } else if !view.offset.is_multiple_of(4) || !size.is_multiple_of(4) {
            format!("{what}: {size} bytes at {} of {} are not aligned to 4 bytes", view.offset, view.label)
        } else {
            return Ok(());
        };
        Err(GpuError::bindings(self.work.name, problem))
    }

    /// Injects the fault planned for this submission, if any.
    fn inject_fault(&mut self) {
        match self.gpu.injector.next() {
            None => {}
            Some(FaultKind::Lost) => self.gpu.driver.device.destroy(),
            Some(FaultKind::GivenUp) => self.work.encoder = self.gpu.driver.encoder(self.work.name),
            Some(FaultKind::Validation) => {
                if let Ok(raw) = lock(&self.gpu.uniforms).chunk(0) {
                    self.work.encoder.clear_buffer(&raw, 0, Some(2 * UNIFORM_CHUNK)); // beyond its end
                }
            }
            Some(FaultKind::OutOfMemory) => {
                self.gpu.driver.faults.report(&wgpu::Error::OutOfMemory { source: "injected fault".into() });
            }
            Some(FaultKind::Full) => fill_device(&self.gpu.driver),
        }
    }

    /// Submits the commands recorded so far and continues with an empty encoder.
    fn flush(&mut self) -> GpuResult<Submission> {
        let gpu = self.gpu;
        // One reference is the device's own, one that of this recorder.
        if Arc::strong_count(&gpu.recordings) > 2 {
            return Err(GpuError::bindings(self.work.name, "two recorders are open at once"));
        }
        let _span = trace::span("submit").of("what", self.work.name);
        if let Some((pipeline, finished)) = gpu.submission_count.as_ref().map(SubmissionCount::counting_dispatch) {
            self.dispatch("submission count", &pipeline, &[finished], [1; 3])?;
        }
        self.work.pass = None;
        let mut profiler = lock(&gpu.profiler);
        let stamps = profiler.resolve(&mut self.work.encoder, &self.work.ticket)?;
        drop(profiler);
        self.work.readbacks.extend(stamps);
        gpu.driver.faults.set_stage(self.work.name);
        self.inject_fault();
        let encoder = std::mem::replace(&mut self.work.encoder, gpu.driver.encoder(self.work.name));
        let commands = encoder.finish();
        gpu.driver.check()?;
        let uniforms = lock(&gpu.uniforms).take(&mut self.work.uniforms);
        let written: usize = uniforms.iter().map(|(_, bytes)| bytes.len()).sum();
        gpu.uploaded.fetch_add(written as u64, Ordering::Relaxed);
        let ticket = std::mem::take(&mut self.work.ticket);
        let mut mappings = std::mem::take(&mut self.work.readbacks);
        lock(&gpu.belt).submit_staged(&ticket, &mut mappings);
        mappings.iter().for_each(Mapping::set_pending);
        gpu.submission_count.iter().for_each(SubmissionCount::note_submission);
        let submitted = gpu
            .driver
            .submitter
            .submit(self.work.name, Job { uniforms, commands, mappings, waker: Waker::of(&ticket) });
        gpu.driver.check()?;
        submitted?;
        lock(&gpu.profiler).collect(4)?;
        let submission = Submission { ticket, name: self.work.name };
        if gpu.serial {
            gpu.wait(&submission)?;
        }
        Ok(submission)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_cover_every_count_and_stay_within_a_dimension() {
        for count in [0u32, 1, 255, 256, 257, 65_535 * 256, 65_535 * 256 + 1, 1 << 28, u32::MAX - (1 << 24)] {
            let [x, y, z] = groups_1d(count, 256);
            assert!(x <= GROUPS_MAX && y <= GROUPS_MAX && z == 1);
            let covered = u64::from(x) * u64::from(y) * 256;
            assert!(covered >= u64::from(count) && covered <= u64::from(u32::MAX) + 1, "{count}: {covered}");
            assert!(
                covered - u64::from(count) < 256 * u64::from(y.max(1)),
                "{count}: one row's workgroup at most is idle"
            );
        }
    }
}
