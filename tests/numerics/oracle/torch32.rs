//! Adam in f32 with the operations of torch.optim.Adam in torch's order. On schedules without a fixture, the errors of
//! deferred Adam are compared with the errors of this imitation.
//!
//! torch 2 on a CPU compiles `lerp_` and `addcmul_` to fused multiply-adds. The fixtures' `param_f32` show that the
//! imitation equals torch up to a few last bits (`adam::torch_in_f32_is_imitated`).

use gsscale::optim::adam::AdamConfig;

/// Values with their moments, all stepped together.
pub struct Torch32 {
    config: AdamConfig,
    steps: u32,
    pub values: Vec<f32>,
    exp_avg: Vec<f32>,
    exp_avg_sq: Vec<f32>,
}

impl Torch32 {
    pub fn new(config: AdamConfig, values: Vec<f32>) -> Self {
        let zeros = vec![0.0; values.len()];
        Torch32 { config, steps: 0, values, exp_avg: zeros.clone(), exp_avg_sq: zeros }
    }

    /// One step at rate `lr`. Numbers of Python are f64, and rounded where they meet a tensor.
    pub fn step(&mut self, grads: &[f32], lr: f64) {
        self.steps += 1;
        let AdamConfig { beta1, beta2, eps } = self.config;
        let t = f64::from(self.steps);
        let [correction1, correction2] = [beta1, beta2].map(|b| 1.0 - libm::pow(b, t));
        let (value, root) = (-(lr / correction1) as f32, correction2.sqrt() as f32);
        let [weight, added] = [beta1, beta2].map(|b| (1.0 - b) as f32);
        for (i, &g) in grads.iter().enumerate() {
            let (m, v) = (&mut self.exp_avg[i], &mut self.exp_avg_sq[i]);
            *m = weight.mul_add(g - *m, *m);
            *v = (added * g).mul_add(g, *v * beta2 as f32);
            self.values[i] += value * *m / (v.sqrt() / root + eps as f32);
        }
    }
}
