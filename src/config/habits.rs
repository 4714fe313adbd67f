//! Names that other trainers of splats give to what a flag here does: gsplat, nerfstudio, Brush, and the program of Kerbl et al. 2023.
//!
//! Invariant: a name stands for a flag here only if the same value has the same effect; for every other name there is advice.

/// Other names of keys: (name, key).
pub const ALIASES: &[(&str, &str)] = &[
    ("iterations", "steps"),
    ("num-iters", "steps"),
    ("max-steps", "steps"),
    ("total-steps", "steps"),
    ("max-num-iterations", "steps"),
    ("downscale-factor", "data-factor"),
    ("cap-max", "max-gaussians"),
    ("max-num-splats", "max-gaussians"),
    ("max-splats", "max-gaussians"),
];

/// Flags of others that are none here: (flag, advice).
pub const ADVICE: &[(&str, &str)] = &[
    ("-r", "--data-factor 4 makes photos a quarter as large, --max-resolution 1600 limits their longer side"),
    ("--resolution", "--data-factor 4 makes photos a quarter as large, --max-resolution 1600 limits their longer side"),
    ("--with-viewer", "--serve 8080 shows the run on a page while it trains"),
    ("--eval", "every eighth photo is held out anyway; --test-every changes that"),
    ("--disable-viewer", "there is no viewer without --serve"),
];

/// The flag among `arguments` for which there is only advice, and the advice.
pub fn advice_for(arguments: &[std::ffi::OsString]) -> Option<(&'static str, &'static str)> {
    let before_rest = arguments.iter().take_while(|argument| *argument != "--");
    let words = before_rest.filter_map(|argument| argument.to_str()).map(|word| word.split('=').next().unwrap_or(word));
    words.into_iter().find_map(|word| ADVICE.iter().find(|(flag, _)| *flag == word)).copied()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::file::{TrainOverrides, parse_arguments};
    use std::ffi::OsString;

    #[derive(clap::Parser)]
    struct Probe {
        #[command(flatten)]
        keys: TrainOverrides,
    }

    #[test]
    fn names_of_others_set_our_keys() {
        for (name, key) in ALIASES {
            let arguments = ["train".to_string(), format!("--{name}"), "4".to_string()].map(OsString::from);
            let given = parse_arguments::<Probe>(&arguments).keys.given();
            assert_eq!(given, [key.replace('-', "_")], "{name}");
        }
    }

    #[test]
    fn advice_is_for_flags_alone() {
        for (flag, advice) in ADVICE {
            assert_eq!(advice_for(&["train".into(), format!("{flag}=4").into()]), Some((*flag, *advice)));
        }
        assert_eq!(advice_for(&["train".into(), "--".into(), "-r".into()]), None);
        assert_eq!(advice_for(&["train".into(), "--resume".into()]), None);
    }
}
