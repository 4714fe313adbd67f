//! config.toml, and the small texts in it and on command lines.

use crate::Target;
use gsscale::base::units::parse_bytes;
use gsscale::config::file::{TrainConfig, default_file};
use gsscale::page::format::codec::Codec;
use gsscale::schedule::order::Order;

pub fn config() -> Target {
    let long = default_file();
    let part = |from: &str, bytes: usize| {
        let at = long.find(from).unwrap_or(0);
        long[at..].chars().take(bytes).collect::<String>().into_bytes()
    };
    let seeds = vec![
        b"steps = 7\nimage-cache = \"64MiB\"\nbackground = [0.5, 0.25, 1.0]\nspill-codec = \"zstd:3\"\n[resolved]\nscene = \"x\"\n".to_vec(),
        b"view-order = \"groups:25\"\nmasks = true\nmeans-lr = 1.6e-4\nadam-eps = 1e-15\ncommit-every = 60.0\n".to_vec(),
        part("\n## Training", 2500),
        part("\n## Memory", 2000),
        b"4GiB".to_vec(),
        b"groups:9".to_vec(),
        b"zstd:19".to_vec(),
    ];
    let words =
        &["[[", "[a.b.c]\n", "\"\"\"", "'''", "{x={", "inf", "nan", "1979-05-27", "= [", "KiB", "groups:", "0x", "_"];
    Target { name: "config", run, seeds, words, cases: 12_000, memory: [512 << 10, 200] }
}

fn run(input: &[u8]) {
    let text = String::from_utf8_lossy(input);
    if let Ok(bytes) = parse_bytes(&text) {
        assert!(bytes < 9_000_000_000_000_000_001);
    }
    if let Ok(codec) = text.parse::<Codec>() {
        assert_eq!(codec.to_string().parse(), Ok(codec));
    }
    let _ = text.parse::<Order>();
    match TrainConfig::parse(&text) {
        Err(problem) => assert!(!problem.is_empty()),
        Ok(config) => {
            if let Err(error) = config.check() {
                assert!(error.to_string().contains("--") && !error.remedy.is_empty(), "{error}");
                return;
            }
            // A valid config is written and read back unchanged.
            let text = toml::to_string(&config).unwrap();
            assert_eq!(TrainConfig::parse(&text), Ok(config));
        }
    }
}
