//! Names that other trainers of splats give to what a flag here does: gsplat, nerfstudio, Brush, and the program of Kerbl et al. 2023.
//!
//! Invariant: a name stands for a flag here only if the same value has the same effect; for every other name there is advice.

/// Other names of keys: (name, key).
pub const ALIASES: &[(&str, &str)] = &[
    ("iterations", "steps"),
    ("num-iters", "steps"),
    ("max-steps", "steps"),
    ("total-steps", "steps"),
    ("total-train-iters", "steps"),
    ("max-num-iterations", "steps"),
    ("downscale-factor", "data-factor"),
    ("cap-max", "max-gaussians"),
    ("max-splats", "max-gaussians"),
];

/// Flags of others that are none here: (flag, advice).
pub const ADVICE: &[(&str, &str)] = &[
    ("-r", "--data-factor 4 makes photos a quarter as large, --max-resolution 1600 limits their longer side"),
    ("--resolution", "--data-factor 4 makes photos a quarter as large, --max-resolution 1600 limits their longer side"),
    ("--max-num-splats", "--max-gaussians 3000000 limits the Gaussians; Postshot counts thousands"),
    ("--with-viewer", "--serve 8080 shows the run on a page while it trains"),
    ("--eval", "every eighth photo is held out anyway; --test-every changes that"),
    ("--disable-viewer", "there is no viewer without --serve"),
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
    words.into_iter().find_map(|word| ADVICE.iter().find(|(flag, _)| is(flag, word))).copied()
}

/// The arguments with `-` for `_` in the names of long flags, as other trainers write them (`--source_path`); not after `--`.
pub fn with_our_spelling(arguments: &[std::ffi::OsString]) -> Vec<std::ffi::OsString> {
    let mut is_rest = false;
    let spelled = arguments.iter().map(|argument| {
        is_rest |= argument == "--";
        let text = argument.to_str().filter(|text| !is_rest && text.starts_with("--"));
        let Some(text) = text else { return argument.clone() };
        let name = text.split('=').next().unwrap_or(text);
        (name.replace('_', "-") + &text[name.len()..]).into()
    });
    spelled.collect()
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
        assert!(advice_for(&["train".into(), "-r2".into()]).is_some() && advice_for(&["-rest".into()]).is_none());
    }

    #[test]
    fn long_flags_may_be_written_with_underscores() {
        let arguments = ["train", "--max_steps", "4", "--data_factor=2", "--", "--my_folder"].map(OsString::from);
        let want = ["train", "--max-steps", "4", "--data-factor=2", "--", "--my_folder"].map(OsString::from);
        assert_eq!(with_our_spelling(&arguments), want);
        let given = parse_arguments::<Probe>(&arguments[..4]).keys.given();
        assert_eq!(given, ["data_factor", "steps"]);
    }
}
