//! Names that other trainers of splats give to what a flag here does: gsplat, nerfstudio, Brush, and the program of Kerbl et al. 2023.
//!
//! Invariant: a name stands for a flag here only if the same value has the same effect; for every other name there is advice.

/// Other names of keys: (names, key).
pub const ALIASES: &[(&[&str], &str)] = &[
    (
        &["iterations", "iter", "num-iters", "max-steps", "total-steps", "total-train-iters", "max-num-iterations"],
        "steps",
    ),
    (&["downscale-factor"], "data-factor"),
    (&["images-path"], "images"),
    (&["llffhold", "eval-interval", "eval-split-every"], "test-every"),
    (&["cap-max", "max-cap", "max-splats", "max-gs-num", "prealloc-capacity"], "max-gaussians"),
    (&["densify-from-iter", "densify-from", "refine-start-iter", "start-refine"], "refine-start"),
    (&["densify-until-iter", "densify-until", "refine-stop-iter", "stop-refine"], "refine-stop"),
    (&["densification-interval"], "refine-every"),
    (&["opacity-reset-interval"], "reset-every"),
    (&["lambda-dssim", "ssim-weight"], "ssim-lambda"),
    (&["export-every"], "save-every"),
    (&["max-scene-batch-cache-size"], "image-cache"),
];

/// Flags of others that are none here: (flags, advice).
pub const ADVICE: &[(&[&str], &str)] = &[
    (
        &["-r", "--resolution", "--resize-factor", "--max-width", "--num-downscales"],
        "--data-factor 4 makes photos a quarter as large, --max-resolution 1600 limits their longer side",
    ),
    (
        &["-d", "-i"],
        "the scene needs no flag: gsscale-train SCENE; --steps 7000 sets the steps, --data-factor 2 makes photos smaller",
    ),
    (&["-n", "--steps-scaler"], "--steps 7000 sets the steps; the schedule follows"),
    (&["--export-name"], "the files of a run have fixed names; --out names their folder"),
    (&["--max-num-splats"], "--max-gaussians 3000000 limits the Gaussians; Postshot counts thousands"),
    (
        &["-v", "--view", "--with-viewer", "--port", "--ip", "--vis", "--websocket-port"],
        "--serve 8080 shows the run on a page while it trains",
    ),
    (&["--disable-viewer", "--headless"], "leave it out: there is no window, and no page without --serve"),
    (&["--eval", "--eval-mode", "--val"], "every eighth photo is held out anyway; --test-every changes that"),
    (&["--test-iterations", "--eval-steps"], "--eval-every 1000 evaluates every 1,000 steps"),
    (
        &[
            "--save-iterations",
            "--checkpoint-iterations",
            "--save-steps",
            "--ply-steps",
            "--steps-per-save",
            "--save-project-at-iter",
        ],
        "--save-every 1000 keeps the Gaussians of every 1,000 steps; what a killed run needs is kept anyway",
    ),
    (
        &[
            "--start-checkpoint",
            "--auto-start-checkpoint",
            "--load-dir",
            "--load-checkpoint",
            "--load-config",
            "--start-iter",
        ],
        "--resume runs/NAME goes on with a run, from its last commit",
    ),
    (&["--ckpt"], "gsscale-eval runs/NAME measures a finished run, --resume runs/NAME goes on with one"),
    (&["--disable-auto-densification"], "--strategy none keeps the number of Gaussians"),
    (
        &[
            "--densify-grad-threshold",
            "--densify-grad-thresh",
            "--growth-grad-threshold",
            "--grad-threshold",
            "--loss-thresh",
        ],
        "--quality draft, normal or archive decides how far a scene grows, --max-gaussians limits it; --strategy default has --grow-grad2d",
    ),
    (&["--growth-stop-iter", "--stop-split-at"], "--refine-stop 15000 is the step at which growth ends"),
    (
        &[
            "--lr",
            "--learning-rate",
            "--position-lr-init",
            "--feature-lr",
            "--opacity-lr",
            "--scaling-lr",
            "--rotation-lr",
            "--sh-lr",
        ],
        "the rates follow --steps and seldom need a change; configs/README.md lists them",
    ),
    (
        &[
            "--data-device",
            "--cache-images",
            "--no-cpu-cache",
            "--dataset-cache-and-stream-mode",
            "--decode-dataset-path",
        ],
        "photos are read as steps need them; --image-cache 4GiB limits the memory of decoded ones",
    ),
    (
        &["--packed", "--split-threshold", "--no-gpu-cache", "--clm-offload", "--naive-offload", "--no-offload"],
        "leave it out: --device-mem limits the GPU's memory, --host-mem the main memory",
    ),
    (&["--memory"], "--host-mem 8GiB limits memory"),
    (&["--scratch-dir"], "--spill-dir FOLDER is for pages that do not fit in memory"),
    (&["--no-masks"], "--masks=false"),
    (
        &[
            "--bilateral-grid",
            "--use-bilateral-grid",
            "--exposure-correction",
            "--ppisp",
            "--app-opt",
            "--post-processing",
        ],
        "--appearance full corrects exposure, colours and vignetting of each photo",
    ),
    (&["--pose-opt", "--camera-optimizer"], "--refine-poses corrects the poses of photos"),
    (
        &["--verbose", "--log-level", "--log-file"],
        "--quiet prints less; metrics.jsonl in the results has every logged step",
    ),
];

/// The flag among `arguments` for which there is only advice, and the advice.
pub fn advice_for(arguments: &[std::ffi::OsString]) -> Option<(&'static str, &'static str)> {
    let before_rest = arguments.iter().take_while(|argument| *argument != "--");
    let words = before_rest.filter_map(|argument| argument.to_str()).map(|word| word.split('=').next().unwrap_or(word));
    // The value of a short flag may follow at once: -r2.
    let is = |flag: &str, word: &str| {
        let rest = word.strip_prefix(flag);
        rest.is_some_and(|rest| rest.is_empty() || flag.len() == 2 && rest.bytes().all(|byte| byte.is_ascii_digit()))
    };
    let all = || ADVICE.iter().flat_map(|(flags, advice)| flags.iter().map(move |flag| (*flag, *advice)));
    words.into_iter().find_map(|word| all().find(|(flag, _)| is(flag, word)))
}

/// The arguments with `-` for `_` in the names of long flags, as other trainers write them (`--source_path`), and without the groups of
/// their names (`--strategy.cap-max`); not after `--`.
pub fn with_our_spelling(arguments: &[std::ffi::OsString]) -> Vec<std::ffi::OsString> {
    let mut is_rest = false;
    let spelled = arguments.iter().map(|argument| {
        is_rest |= argument == "--";
        let text = argument.to_str().filter(|text| !is_rest && text.starts_with("--"));
        let Some(text) = text else { return argument.clone() };
        let name = text.split('=').next().unwrap_or(text);
        let alone = name.rsplit('.').next().unwrap_or(name).trim_start_matches('-');
        format!("--{}{}", alone.replace('_', "-"), &text[name.len()..]).into()
    });
    spelled.collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::command_line::parse_arguments;
    use crate::config::file::TrainOverrides;
    use std::ffi::OsString;

    #[derive(clap::Parser)]
    struct Probe {
        #[command(flatten)]
        keys: TrainOverrides,
    }

    #[test]
    fn names_of_others_set_our_keys() {
        for (name, key) in ALIASES.iter().flat_map(|(names, key)| names.iter().map(move |name| (name, key))) {
            let value = if *key == "image-cache" { "4GiB" } else { "4" };
            let arguments = ["train".to_string(), format!("--{name}"), value.to_string()].map(OsString::from);
            let given = parse_arguments::<Probe>(&arguments).keys.given();
            assert_eq!(given, [key.replace('-', "_")], "{name}");
        }
    }

    #[test]
    fn advice_is_for_flags_alone() {
        for (flag, advice) in ADVICE.iter().flat_map(|(flags, advice)| flags.iter().map(move |flag| (flag, advice))) {
            assert_eq!(advice_for(&["train".into(), format!("{flag}=4").into()]), Some((*flag, *advice)));
        }
        assert_eq!(advice_for(&["train".into(), "--".into(), "-r".into()]), None);
        assert_eq!(advice_for(&["train".into(), "--resume".into()]), None);
        assert!(advice_for(&["train".into(), "-r2".into()]).is_some() && advice_for(&["-rest".into()]).is_none());
    }

    #[test]
    fn long_flags_may_be_written_with_underscores() {
        let arguments = ["train", "--max_steps", "4", "--data_factor=2", "--", "--my_folder"].map(OsString::from);
        let want = ["train", "--max-steps", "4", "--data-factor=2", "--", "--my_folder"].map(OsString::from);
        assert_eq!(with_our_spelling(&arguments), want);
        let given = parse_arguments::<Probe>(&arguments[..4]).keys.given();
        assert_eq!(given, ["data_factor", "steps"]);
        let arguments = ["train", "--machine.seed", "4", "--strategy.cap-max=9", "--"].map(OsString::from);
        assert_eq!(parse_arguments::<Probe>(&arguments).keys.given(), ["seed", "max_gaussians"]);
    }
}
