//! Runs that are stopped early, and the output of `gsscale-ckpt` on their stores.

use crate::support::scenes::stderr;
use crate::support::workdir::{CKPT, Running, Workdir, open_store, split_ply};
use gsscale::page::map::opening::StoredPage;
use gsscale::page::tool::reading::{Access, StoreReader, WitnessRule};
use serde_json::Value;
use std::collections::BTreeMap;
use std::ops::Deref;
use std::path::{Path, PathBuf};

/// Rounds, resets and raises of the SH degree before the stop; pages that split.
const BUSY: &str = "scene --steps 400 --page-rows 32 --grow-grad2d 0.001 --refine-start 15 --refine-every 10 --refine-stop 100 \
    --reset-every 40 --sh-every 20 --view-order groups:4 --log-every 3 --eval-every 12 --test-every 12 --device cpu --frames 4000 \
    --commit-every 0 --quiet";

/// Names of the pages that differ between two generations of a store.
pub fn changed_pages(store: &Path, from: u64, to: u64) -> Vec<String> {
    let store = StoreReader::open(store, Access::Map, WitnessRule::Obeyed).unwrap();
    let before = store.pages_at(from).unwrap();
    let is_changed = |page: &StoredPage| before.iter().any(|b| b.page == page.page && b.slot != page.slot);
    store.pages_at(to).unwrap().iter().filter(|page| is_changed(page)).map(|page| page.page.to_string()).collect()
}

/// A scene, and one run on it at a time, in `out`, with its pages in `spill`.
pub struct Bench(Workdir);

impl Deref for Bench {
    type Target = Workdir;

    fn deref(&self) -> &Workdir {
        &self.0
    }
}

impl Bench {
    pub fn new() -> Bench {
        Bench(Workdir::city_of(24, [48, 36], 3000, 12))
    }

    /// Without a scene.
    pub fn empty() -> Bench {
        Bench(Workdir::new())
    }

    pub fn spill(&self) -> PathBuf {
        self.path("spill")
    }

    /// The uninterrupted run, in memory, in `alone`; returns its PLY.
    pub fn alone(&self, more: &str) -> Vec<u8> {
        self.train(&format!("{BUSY} --out alone {more}"));
        self.ply("alone")
    }

    pub fn running(&self, more: &str) -> Running<'_> {
        self.begin(&format!("{BUSY} --out out --spill-dir spill {more}")).after_lines("out", 19)
    }

    /// A run stopped twice, some steps apart, long before its end: two generations.
    pub fn stopped(&self, more: &str) {
        self.running(more).signal("TERM").ends(143);
        self.go_on_until_stopped("");
    }

    pub fn go_on(&self, more: &str) {
        self.train(&format!("--resume out --quiet {more}"));
    }

    /// Resumes the run for a few steps.
    pub fn go_on_until_stopped(&self, more: &str) {
        self.going_on(more).signal("TERM").ends(143);
    }

    /// A resumed run, some steps later.
    pub fn going_on(&self, more: &str) -> Running<'_> {
        let lines = self.lines("out");
        self.begin(&format!("--resume out --quiet {more}")).after_lines("out", lines + 3)
    }

    /// What `gsscale-ckpt` prints.
    pub fn ckpt(&self, flags: &str) -> String {
        self.printed(CKPT, flags)
    }

    /// The output with `--json`.
    pub fn ckpt_json(&self, flags: &str) -> Value {
        serde_json::from_str(&self.ckpt(&format!("{flags} --json"))).unwrap()
    }

    /// The message of a failing call, which has all of these words.
    pub fn fails(&self, flags: &str, words: &[&str]) -> String {
        let output = self.output(CKPT, flags);
        let said = stderr(&output);
        assert!(matches!(output.status.code(), Some(1 | 2)), "{flags}: {output:?}");
        assert!(words.iter().all(|word| said.contains(word)), "{flags}: {words:?}: {said}");
        said
    }

    /// No page of any generation of the store is damaged.
    pub fn is_intact(&self, dir: &str) -> bool {
        self.ckpt_json(&format!("verify {dir} --deep"))["faults"].as_array().unwrap().is_empty()
    }

    pub fn generations(&self, dir: &str) -> Vec<u64> {
        generations(&self.ckpt_json(&format!("ls {dir}")))
    }

    pub fn export(&self, dir: &str, more: &str) -> Vec<u8> {
        self.ckpt(&format!("export {dir} --out exported.ply {more}"));
        let bytes = self.bytes("exported.ply");
        std::fs::remove_file(self.path("exported.ply")).unwrap();
        bytes
    }

    /// Every file of the spill directory with its bytes and modification time.
    pub fn store_files(&self) -> BTreeMap<PathBuf, (Vec<u8>, std::time::SystemTime)> {
        let entries = std::fs::read_dir(self.spill()).unwrap().map(|entry| entry.unwrap().path());
        entries
            .map(|path| {
                let written = std::fs::metadata(&path).unwrap().modified().unwrap();
                let bytes = std::fs::read(&path).unwrap();
                (path, (bytes, written))
            })
            .collect()
    }
}

/// The numbers in the output of `ls --json`.
pub fn generations(listed: &Value) -> Vec<u64> {
    listed["generations"].as_array().unwrap().iter().map(|g| g["generation"].as_u64().unwrap()).collect()
}

/// Names generations, as the trainer does.
pub fn pin(spill: &Path, names: &[(&str, u64)]) {
    let (_lock, mut opened, mut store) = open_store(spill);
    let names: Vec<(String, u64)> = names.iter().map(|(name, generation)| ((*name).to_string(), *generation)).collect();
    opened.commits.pin(&mut store, &names, &[]).unwrap();
}

/// A PLY of floats, read without gsscale's reader.
pub struct Ply {
    pub names: Vec<String>,
    pub rows: Vec<Vec<f32>>,
}

impl Ply {
    pub fn of(bytes: &[u8]) -> Ply {
        let (header, rows) = split_ply(bytes);
        let names: Vec<String> =
            header.lines().filter_map(|l| l.strip_prefix("property float ")).map(str::to_string).collect();
        let value = |b: &[u8]| f32::from_le_bytes(b.try_into().unwrap());
        let rows: Vec<Vec<f32>> =
            rows.chunks_exact(4 * names.len()).map(|row| row.chunks_exact(4).map(value).collect()).collect();
        let count = header.lines().find_map(|l| l.strip_prefix("element vertex ")).unwrap();
        assert_eq!(rows.len(), count.parse::<usize>().unwrap());
        Ply { names, rows }
    }

    pub fn median(&self) -> [f64; 3] {
        std::array::from_fn(|i| {
            let mut values: Vec<f32> = self.rows.iter().map(|row| row[i]).collect();
            values.sort_by(f32::total_cmp);
            f64::from(values[values.len() / 2])
        })
    }

    /// Opacity times the area of the two longest axes.
    pub fn visibility(&self, row: &[f32]) -> f64 {
        let at = |name: &str| f64::from(row[self.names.iter().position(|n| n == name).unwrap()]);
        let mut scales = [at("scale_0"), at("scale_1"), at("scale_2")];
        scales.sort_by(f64::total_cmp);
        (scales[1] + scales[2]).exp() / (1.0 + (-at("opacity")).exp())
    }
}
