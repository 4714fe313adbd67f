//! The stages in order on the CPU, forward and backward, with the memory that they share.
//!
//! Invariants: 1. nothing is allocated per view once the largest view was seen; 2. the result has the same bits for any
//! number of threads, and on the AVX2 and AVX-512 paths; 3. `backward` belongs to the last `forward` and must be given
//! the same rows.

use super::{Gradients, LossOptions, LossValue, RenderError, RenderOptions, Renderer};
use crate::kernels::image_loss::ImageLoss;
use crate::kernels::isect_emit::{count, emit};
use crate::kernels::isect_offsets::isect_offsets;
use crate::kernels::project_bwd::project_bwd;
use crate::kernels::project_fwd::{Projected, project_fwd};
use crate::kernels::radix_sort::DepthSort;
use crate::kernels::rasterize_bwd::{FootprintGradients, Partial, Upstream, fold_rows, rasterize_bwd};
use crate::kernels::rasterize_fwd::{Lists, Raster, rasterize_fwd, untile};
use crate::kernels::scan::scan;
use crate::kernels::sh_bwd::sh_bwd;
use crate::kernels::sh_fwd::sh_fwd;
use crate::kernels::splats::{Grid, Packed, pack};
use crate::kernels::stages::STAGES;
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use crate::scene::image::{Image, Target};
use std::sync::atomic::AtomicU64;
use std::time::Instant;

/// Counters of the last view.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct RenderStats {
    /// Rows that were drawn.
    pub visible: u64,
    /// Intersections of rows and tiles.
    pub isects: u64,
    /// Pixel-Gaussian pairs that the forward pass evaluated.
    pub evaluated: u64,
}

/// Seconds of each stage of [`STAGES`] in the last view.
#[derive(Debug, Default)]
struct StageClock {
    seconds: [f64; STAGES.len()],
}

impl StageClock {
    /// Runs the stage of this name and notes its time.
    fn time<T>(&mut self, stage: &str, work: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let out = work();
        if let Some(at) = STAGES.iter().position(|s| s.name == stage) {
            self.seconds[at] = start.elapsed().as_secs_f64();
        }
        out
    }
}

/// Renders views on the CPU.
#[derive(Debug, Default)]
pub struct CpuRenderer {
    image: Image,
    alpha: Vec<f32>,
    view: Option<(Camera, RenderOptions)>,
    projected: Projected,
    colors: Vec<[f32; 3]>,
    depth_sort: DepthSort,
    order: Vec<u32>,
    packed: Packed,
    tile_counts: Vec<u32>,
    /// Emit offsets by chunk of rows.
    chunk_offsets: Vec<u64>,
    tile_offsets: Vec<u64>,
    cursors: Vec<u64>,
    isects: Vec<AtomicU64>,
    raster: Raster,
    partials: Vec<Partial>,
    footprints: FootprintGradients,
    image_loss: ImageLoss,
    v_rgb: Vec<f32>,
    stats: RenderStats,
    clock: StageClock,
}

impl CpuRenderer {
    /// A renderer without memory yet.
    pub fn new() -> Self {
        CpuRenderer::default()
    }

    /// Renders `rows` as seen by `camera`.
    ///
    /// # Panics
    /// When a side of the image is above [`Grid::SIDE_MAX`], or there are 2^32 rows or more.
    pub fn forward(&mut self, rows: &Columns, camera: &Camera, options: &RenderOptions) -> &Image {
        let side = camera.width.max(camera.height);
        assert!(side <= Grid::SIDE_MAX, "images are at most {} pixels on a side, not {side}", Grid::SIDE_MAX);
        assert!(rows.rows() < u32::MAX as usize, "too many rows in one view");
        let grid = Grid::new(camera.width, camera.height);
        let mut clock = StageClock::default();
        let simd = options.simd;
        clock.time("project_fwd", || project_fwd(rows, camera, options.eps2d, simd, &mut self.projected));
        clock.time("sh_fwd", || {
            sh_fwd(rows, camera, options.sh_degree, &self.projected, simd, &mut self.colors);
        });
        clock.time("radix_sort", || {
            self.depth_sort.sort(&self.projected.depths, &self.projected.radii, &mut self.order);
        });
        let total = clock.time("scan", || {
            pack(&self.projected, &self.colors, grid, simd, &mut self.packed);
            scan(&self.packed.chunk_counts, &mut self.chunk_offsets)
        });
        clock.time("isect_offsets", || {
            count(&self.order, &self.packed, grid, simd, &mut self.tile_counts);
            isect_offsets(&self.tile_counts, grid.tiles(), &mut self.tile_offsets, &mut self.cursors);
        });
        clock.time("isect_emit", || {
            emit(&self.order, &self.packed, grid, simd, total, &mut self.cursors, &mut self.isects)
        });
        self.view = Some((*camera, *options));
        clock.time("rasterize_fwd", || self.rasterize(grid, options));
        self.clock = clock;
        self.stats = RenderStats {
            visible: self.order.len() as u64,
            isects: total,
            evaluated: self.raster.evaluated.iter().sum(),
        };
        &self.image
    }

    fn rasterize(&mut self, grid: Grid, options: &RenderOptions) {
        let mut raster = std::mem::take(&mut self.raster);
        rasterize_fwd(&self.lists(grid, options), &mut raster);
        self.raster = raster;
        let pixels = grid.width as usize * grid.height as usize;
        (self.image.width, self.image.height) = (grid.width, grid.height);
        self.image.rgb.resize(3 * pixels, 0.0);
        self.alpha.resize(pixels, 0.0);
        untile(grid, &self.raster, &mut self.image.rgb, &mut self.alpha);
    }

    fn lists(&self, grid: Grid, options: &RenderOptions) -> Lists<'_> {
        Lists {
            grid,
            splats: &self.packed.splats,
            isects: &self.isects,
            tile_offsets: &self.tile_offsets,
            max_alpha: options.max_alpha,
            background: options.background,
            simd: options.simd,
        }
    }

    /// The picture of the last [`CpuRenderer::forward`].
    pub fn image(&self) -> &Image {
        &self.image
    }

    /// Its coverage 1 - T, `[height][width]`.
    pub fn alpha(&self) -> &[f32] {
        &self.alpha
    }

    /// What the last forward pass left of each tile.
    pub fn raster(&self) -> &Raster {
        &self.raster
    }

    /// Footprints of the last view, one entry per row.
    pub fn projected(&self) -> &Projected {
        &self.projected
    }

    /// Gradients of the last view's rows, from `v_rgb` (`[3][height][width]`) and `v_alpha` (`[height][width]`).
    /// Every entry of `grads` is written; rows that were not drawn get zeros.
    ///
    /// # Panics
    /// Without a forward pass before it, or when sizes disagree with it.
    pub fn backward(&mut self, rows: &Columns, v_rgb: &[f32], v_alpha: Option<&[f32]>, grads: &mut Gradients) {
        assert_eq!(self.projected.radii.len(), rows.rows(), "backward needs the rows of the last forward");
        assert_eq!(v_rgb.len(), self.image.rgb.len(), "v_rgb has the size of the image");
        assert!(v_alpha.is_none_or(|v| v.len() == self.alpha.len()), "v_alpha has the size of the image");
        let Some((camera, options)) = self.view else { panic!("backward needs a forward pass before it") };
        let grid = Grid::new(camera.width, camera.height);
        let mut clock = std::mem::take(&mut self.clock);
        clock.time("rasterize_bwd", || self.rasterize_back(grid, &options, &Upstream { v_rgb, v_alpha }));
        let columns = &mut grads.columns;
        columns.sh_degree = rows.sh_degree;
        columns.resize(rows.rows());
        let (projected, simd, out) = (&self.projected, options.simd, &self.footprints);
        clock.time("sh_bwd", || {
            sh_bwd(rows, &camera, options.sh_degree, projected, &self.colors, &out.v_colors, simd, columns);
        });
        let (v_means2d, v_conics, v_opacities) = (&out.v_means2d, &out.v_conics, &out.v_opacities);
        clock.time("project_bwd", || {
            project_bwd(rows, &camera, options.eps2d, projected, v_means2d, v_conics, v_opacities, simd, columns);
        });
        grads.means2d.clone_from(&out.v_means2d);
        grads.radii.clone_from(&projected.radii);
        self.clock = clock;
    }

    fn rasterize_back(&mut self, grid: Grid, options: &RenderOptions, upstream: &Upstream<'_>) {
        let mut partials = std::mem::take(&mut self.partials);
        rasterize_bwd(&self.lists(grid, options), &self.chunk_offsets, &self.raster, upstream, &mut partials);
        self.partials = partials;
        fold_rows(&self.packed.counts, &self.chunk_offsets, &self.partials, &self.projected, &mut self.footprints);
    }

    /// Seconds that each stage took in the last view, in the order of [`STAGES`] (0 for those that did not run).
    pub fn stage_seconds(&self) -> impl Iterator<Item = (&'static str, f64)> + '_ {
        STAGES.iter().zip(self.clock.seconds).map(|(stage, seconds)| (stage.name, seconds))
    }

    /// Counters of the last view.
    pub fn stats(&self) -> RenderStats {
        self.stats
    }

    /// Bytes that this renderer holds now.
    pub fn scratch_bytes(&self) -> u64 {
        let p = &self.projected;
        let f = &self.footprints;
        self.depth_sort.bytes()
            + self.raster.bytes()
            + bytes(&self.image.rgb)
            + bytes(&self.alpha)
            + bytes(&self.v_rgb)
            + (bytes(&p.means2d) + bytes(&p.conics) + bytes(&p.depths) + bytes(&p.radii) + bytes(&p.opacities))
            + (bytes(&self.colors) + bytes(&self.order) + bytes(&self.packed.splats))
            + (bytes(&self.packed.counts)
                + bytes(&self.packed.spans)
                + bytes(&self.tile_counts)
                + bytes(&self.chunk_offsets)
                + bytes(&self.packed.chunk_counts)
                + bytes(&self.tile_offsets))
            + (bytes(&self.cursors) + bytes(&self.isects) + bytes(&self.partials))
            + (bytes(&f.v_means2d) + bytes(&f.v_conics) + bytes(&f.v_colors) + bytes(&f.v_opacities))
    }
}

impl Renderer for CpuRenderer {
    fn name(&self) -> &'static str {
        "cpu"
    }

    fn host_bytes(&self) -> u64 {
        self.scratch_bytes()
    }

    fn forward(&mut self, rows: &Columns, camera: &Camera, options: &RenderOptions) -> Result<(), RenderError> {
        super::check_view(rows, camera, options)?;
        self.forward(rows, camera, options);
        Ok(())
    }

    fn image(&mut self) -> Result<&Image, RenderError> {
        if self.view.is_some() { Ok(&self.image) } else { Err(RenderError::NoForward) }
    }

    fn loss_backward(
        &mut self,
        rows: &Columns,
        target: &Target,
        options: &LossOptions,
        grads: &mut Gradients,
    ) -> Result<LossValue, RenderError> {
        if self.view.is_none() || self.projected.rows() != rows.rows() {
            return Err(RenderError::NoForward);
        }
        let image = (self.image.width, self.image.height);
        if (target.width, target.height) != image {
            return Err(RenderError::TargetSize { target: (target.width, target.height), image });
        }
        let mut v_rgb = std::mem::take(&mut self.v_rgb);
        let value = self.image_loss.value_and_gradient(&self.image, target, options, &mut v_rgb);
        self.backward(rows, &v_rgb, None, grads);
        self.v_rgb = v_rgb;
        Ok(value)
    }
}

fn bytes<T>(v: &Vec<T>) -> u64 {
    (v.capacity() * size_of::<T>()) as u64
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};
    use crate::base::simd::SimdPath;

    /// `rows` Gaussians in front of a camera, some of them large, opaque, behind it or off the picture.
    fn scene(rows: usize, width: u32, height: u32) -> (Columns, Camera) {
        let mut draws = Stream::new(11, Purpose::Test, rows as u64, 0);
        let mut c = Columns::zeros(rows, 2);
        c.means.iter_mut().for_each(|x| *x = draws.range(-2.0, 2.0) as f32);
        c.quats.iter_mut().for_each(|x| *x = draws.normal() as f32);
        c.scales.iter_mut().for_each(|x| *x = draws.range(-5.0, -1.0) as f32);
        c.opacities.iter_mut().for_each(|x| *x = draws.range(-6.0, 7.0) as f32);
        c.sh0.iter_mut().chain(&mut c.sh_n).for_each(|x| *x = 0.5 * draws.normal() as f32);
        let viewmat = [[1.0, 0.0, 0.0, 0.1], [0.0, 1.0, 0.0, -0.2], [0.0, 0.0, 1.0, 1.5]];
        let (fx, fy, cx, cy) = (60.0, 65.0, 0.5 * width as f32, 0.5 * height as f32);
        (c, Camera { viewmat, fx, fy, cx, cy, width, height, near_plane: 0.01, far_plane: 1e10 })
    }

    fn bits(values: &[f32]) -> Vec<u32> {
        values.iter().map(|x| x.to_bits()).collect()
    }

    /// Bits of image, alpha and all gradients on a path with a number of threads.
    fn render_bits(rows: &Columns, camera: &Camera, simd: SimdPath, threads: usize) -> Vec<Vec<u32>> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut renderer = CpuRenderer::new();
            let options = RenderOptions { sh_degree: 2, background: [0.2, 0.4, 0.1], simd, ..RenderOptions::default() };
            renderer.forward(rows, camera, &options);
            let mut draws = Stream::new(12, Purpose::Test, 0, 0);
            let v_rgb: Vec<f32> = renderer.image().rgb.iter().map(|_| draws.normal() as f32).collect();
            let v_alpha: Vec<f32> = renderer.alpha().iter().map(|_| draws.normal() as f32).collect();
            let mut grads = Gradients::default();
            renderer.backward(rows, &v_rgb, Some(&v_alpha), &mut grads);
            let mut all = vec![bits(&renderer.image().rgb), bits(renderer.alpha()), bits(grads.means2d.as_flattened())];
            all.extend(crate::scene::columns::Column::ALL.map(|c| bits(grads.columns.column(c))));
            all
        })
    }

    #[test]
    fn threads_do_not_change_a_bit() {
        // Enough rows for several chunks in every stage.
        let (rows, camera) = scene(20_000, 123, 77);
        let one = render_bits(&rows, &camera, SimdPath::best(), 1);
        assert!(one.iter().flatten().any(|b| *b != 0));
        for threads in [2, 16] {
            assert!(one == render_bits(&rows, &camera, SimdPath::best(), threads), "{threads} threads");
        }
    }

    #[test]
    fn avx2_and_avx512_agree_to_the_bit() {
        if !SimdPath::Avx512.is_supported() {
            println!("SKIPPED: this machine has no AVX-512");
            return;
        }
        let (rows, camera) = scene(3000, 100, 60);
        let wide = render_bits(&rows, &camera, SimdPath::Avx512, 1);
        assert!(wide == render_bits(&rows, &camera, SimdPath::Avx2, 1));
    }

    #[test]
    fn empty_scenes_show_the_background() {
        let options = RenderOptions { sh_degree: 0, background: [0.25, 0.5, 0.75], ..RenderOptions::default() };
        let mut renderer = CpuRenderer::new();
        let mut grads = Gradients::default();
        for (n, width, height) in [(0, 33, 17), (50, 1, 1), (50, 16, 16), (0, 0, 0)] {
            let (mut rows, camera) = scene(n, width, height);
            // All behind the camera.
            rows.means.iter_mut().for_each(|x| *x -= 10.0);
            let image = renderer.forward(&rows, &camera, &options);
            let pixels = camera.pixels();
            let want: Vec<f32> = [0.25, 0.5, 0.75].iter().flat_map(|&c| vec![c; pixels]).collect();
            assert_eq!(image.rgb, want);
            renderer.backward(&rows, &want, None, &mut grads);
            assert_eq!(grads.columns, Columns::zeros(n, 2));
            assert_eq!(grads.radii, vec![[0, 0]; n]);
            assert_eq!(renderer.stats(), RenderStats::default());
        }
    }

    #[test]
    fn memory_stops_growing_once_warm() {
        let (rows, camera) = scene(5000, 123, 77);
        let options = RenderOptions { sh_degree: 1, ..RenderOptions::default() };
        let mut renderer = CpuRenderer::new();
        let mut grads = Gradients::default();
        let mut held = Vec::new();
        for _ in 0..3 {
            let v_rgb = renderer.forward(&rows, &camera, &options).rgb.clone();
            renderer.backward(&rows, &v_rgb, None, &mut grads);
            held.push(renderer.scratch_bytes());
        }
        assert!(held[0] > 0 && held[1] == held[0] && held[2] == held[0], "{held:?}");
    }
}
