//! A city in cells through the program: the bytes of a cell, its failures, the ring, and the merge.

use crate::support::scenes::{add_boxes, told};
use crate::support::workdir::{CKPT, Running, Workdir, says};
use gsscale::dataset::synthetic::{CityOptions, write_city};
use gsscale::exchange::meta::ExportFrame;
use gsscale::scene::columns::Column;
use gsscale::train::stores::StoredStart;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

const CELLS: &str = env!("CARGO_BIN_EXE_gsscale-cells");
const GIB: u64 = 1 << 30;
/// What is trained, so small that a cell takes a second.
const KEYS: &str = "--max-gaussians 4000 --page-rows 32";
const ON_CPU: &str = "--device cpu --quiet";

struct Cells(Workdir);

impl Cells {
    /// A city of this many steps that is cut with these flags.
    fn cut(steps: u32, flags: &str) -> Cells {
        let cells = Cells(Workdir::wide_city(3000));
        cells.done(&format!("prior scene --out city --steps {steps} {KEYS} --export-frame local"));
        cells.done(&format!("cut scene --out city {flags}"));
        cells
    }

    /// Runs the program, on the CPU where it trains; returns the exit code, and what it said.
    fn says(&self, flags: &str) -> (Option<i32>, String) {
        let trains = ["prior", "cut", "run"].iter().any(|command| flags.starts_with(command));
        let output = self.0.output(CELLS, &format!("{flags} {}", if trains { ON_CPU } else { "" }));
        (output.status.code(), told(&output))
    }

    fn done(&self, flags: &str) -> String {
        let (code, said) = self.says(flags);
        assert_eq!(code, Some(0), "{flags}: {said}");
        said
    }

    fn plan(&self) -> toml::Table {
        self.0.text("city/plan.toml").parse().unwrap()
    }

    fn count(&self) -> usize {
        self.plan()["cells"].as_array().unwrap().len()
    }

    fn refuses(&self, flags: &str, words: &[&str]) {
        let (code, said) = self.says(flags);
        assert_eq!(code, Some(2), "{flags}: {said}");
        says(&said, words);
        says(&said, &["remedy"]);
    }

    /// The path in `folder` of the one entry whose name begins so.
    fn only(&self, folder: &str, begin: &str) -> String {
        let entries = std::fs::read_dir(self.0.path(folder)).unwrap();
        let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let names: Vec<String> = names.filter(|name| name.starts_with(begin)).collect();
        assert_eq!(names.len(), 1, "{folder}/{begin}: {names:?}");
        format!("{folder}/{}", names[0])
    }

    /// The output folder of a cell's run in the city.
    fn run_of(&self, cell: usize) -> String {
        self.only(&format!("city/cells/{cell}"), "run-")
    }

    /// The folder of the cell on a drive.
    fn place(&self, drive: &str, cell: usize) -> String {
        self.only(drive, &format!("cell-{cell}-"))
    }

    /// The newest whole copy of a cell.
    fn newest(&self, cell: usize) -> Option<u32> {
        let copies = std::fs::read_dir(self.0.path(&format!("city/cells/{cell}/copy"))).into_iter().flatten();
        copies.filter_map(|copy| copy.unwrap().file_name().to_str()?.parse().ok()).max()
    }

    fn copy(&self, cell: usize) -> PathBuf {
        self.0.path(&format!("city/cells/{cell}/copy/{}", self.newest(cell).unwrap()))
    }

    /// As if the cell had never been worked on.
    fn forget(&self, cell: usize) {
        self.0.remove(&self.run_of(cell));
        self.0.remove(&format!("city/cells/{cell}/copy"));
        std::fs::remove_file(self.0.path(&format!("city/cells/{cell}/done.toml"))).unwrap();
    }

    fn begin(&self, flags: &str) -> Running<'_> {
        Running::spawn(&self.0, &mut self.0.command(CELLS, &format!("{flags} {ON_CPU}")))
    }
}

/// A prior of enough steps finds out whether photos contradict each other. Cells, which begin from Gaussians, cannot.
#[test]
fn cells_mask_what_their_prior_has_masked() {
    let cells = Cells(Workdir::city(24, 64, 48, 1500));
    add_boxes(&cells.0.photos());
    cells.done(&format!("prior scene --out city --steps 4800 {KEYS} --strategy none"));
    cells.done("cut scene --out city --cells 2");
    says(&cells.0.text("city/cells/1/cell.toml"), &["robust-pixels = \"on\""]);
}

/// Swept points are for the prior; cells begin from its Gaussians.
#[test]
fn a_city_of_swept_points_is_trained_and_keys_that_no_cell_takes_are_refused_at_once() {
    let cells = Cells(Workdir::city(16, 64, 48, 800));
    cells.done(&format!("prior scene --out city --steps 40 {KEYS} --sweep-points --view-order auto"));
    cells.done("cut scene --out city --cells 1");
    let cell = cells.0.text("city/cells/0/cell.toml");
    assert!(cell.contains("view-order = \"shuffle\"") && !cell.contains("sweep-points"), "{cell}");
    cells.done("run city --cell 0");
    let flags = format!("prior scene --out other --steps 40 {KEYS} --optimizer-on device --device gpu");
    let output = cells.0.output(CELLS, &flags);
    assert_eq!(output.status.code(), Some(2), "{}", told(&output));
    says(&told(&output), &["--optimizer-on device", "leave it out"]);
    assert!(!cells.0.exists("other"));
}

#[test]
fn one_cell_equals_the_plain_run_from_the_same_prior() {
    let cells = Cells::cut(120, "--cells 1");
    says(&cells.0.text("city/cells/0/cell.toml"), &["robust-pixels = \"off\""]);
    cells.done("run city --cell 0");
    says(&cells.done("run city --cell 0"), &["cell 0 is done"]);
    let plain = "--config city/cells/0/cell.toml --schedule run-length --strategy long-axis";
    let plain = cells.0.run("plain", &format!("{plain} --init-ply city/prior/store"));
    assert!(cells.0.ply(&cells.run_of(0)) == plain, "the scenes differ");
    // A cell whose copy is gone is not done: on a drive and in few frames, too.
    cells.0.remove("city/cells/0/copy");
    says(&cells.done("status city"), &["0 of 1 cells are done"]);
    cells.done("run city --cell 0");
    assert!(cells.0.ply(&cells.run_of(0)) == plain, "the scenes differ");
    cells.0.remove("city/cells/0/copy");
    std::fs::create_dir(cells.0.path("nvme")).unwrap();
    cells.done("run city --cell 0 --spill-dir nvme --frames 60");
    assert!(cells.0.ply(&format!("{}/run", cells.place("nvme", 0))) == plain, "the scenes differ");
    // One without the file goes on from the copy.
    std::fs::remove_file(cells.0.path("city/cells/0/done.toml")).unwrap();
    cells.done("run city --cell 0");
    says(&cells.done("status city"), &["1 of 1 cells are done"]);
    scene_of_other_poses_is_refused(&cells);
    another_prior_is_refused(&cells);
}

/// The photos have the same names, and one camera stands elsewhere.
fn scene_of_other_poses_is_refused(cells: &Cells) {
    std::fs::remove_file(cells.0.path("city/cells/0/done.toml")).unwrap();
    let (file, at) = ("scene/sparse/0/images.bin", 8 + 4 + 4 * 8);
    let whole = cells.0.bytes(file);
    let mut moved = whole.clone();
    moved[at + 6] ^= 1;
    cells.0.write(file, moved);
    cells.refuses("run city --cell 0", &["have changed since the city was cut"]);
    cells.0.write(file, whole);
    cells.done("run city --cell 0");
}

/// A prior of as many rows that differ in one bit is another one.
fn another_prior_is_refused(cells: &Cells) {
    let ply = "city/prior/run/point_cloud.ply";
    let mut rows = cells.0.bytes(ply);
    *rows.last_mut().unwrap() ^= 1;
    cells.0.write(ply, rows);
    cells.0.remove("city/prior/store");
    cells.0.succeeds(CKPT, &format!("import {ply} --out city/prior/store --page-rows 32"));
    std::fs::remove_file(cells.0.path("city/cells/0/done.toml")).unwrap();
    cells.refuses("run city --cell 0", &["it is not the prior that was cut"]);
}

#[test]
fn cells_that_are_killed_and_move_end_with_the_same_bytes_and_merge_by_place() {
    let cells = Cells::cut(120, "--cells 3");
    for cell in 0..3 {
        cells.done(&format!("run city --cell {cell}"));
    }
    let alone = cells.0.ply(&cells.run_of(1));
    says(&cells.done("status city"), &["3 of 3 cells are done"]);
    ring_is_frozen(&cells, 1);
    // A merge that fails leaves nothing.
    let (pages, away) = (cells.copy(2).join("FORMAT"), cells.0.path("away"));
    std::fs::rename(&pages, &away).unwrap();
    let (code, said) = cells.says("merge city --out whole");
    assert!(code != Some(0) && !cells.0.exists("whole") && !cells.0.exists(".whole.part"), "{said}");
    std::fs::rename(&away, &pages).unwrap();
    let listed = cells.0.text("city/cells/2/pages.txt");
    cells.0.write("city/cells/2/pages.txt", listed.lines().rev().map(|line| format!("{line}\n")).collect::<String>());
    cells.refuses("merge city --out whole", &["was changed after the cut"]);
    cells.0.write("city/cells/2/pages.txt", listed);
    let merged = cells.done("merge city --out whole");
    says(&cells.0.text("whole/polish.toml"), &["export-clean = \"off\"", "strategy = \"none\""]);
    merge_is_by_place(&cells, &merged);
    assert_eq!(cells.done("merge city --out whole"), merged, "a second merge says what the first one has done");
    // As if nothing had been done; then machines in turn, each killed once it has copied a commit, the first one before.
    cells.forget(1);
    ["one", "two"].iter().for_each(|drive| std::fs::create_dir(cells.0.path(drive)).unwrap());
    let run_on = |drive: &str| format!("{}/run", cells.place(drive, 1));
    let flags = "run city --cell 1 --commit-every 0.01";
    let committed =
        || cells.0.path("one").read_dir().unwrap().next().is_some() && cells.0.has_committed(&run_on("one"));
    let worker = cells.begin(&format!("{flags} --log-every 1 --spill-dir one"));
    assert!(worker.once(committed).kill());
    for place in ["--spill-dir two", "", "--spill-dir one"] {
        let before = cells.newest(1);
        let worker = cells.begin(&format!("{flags} --copy-every 0.05 {place}"));
        assert!(worker.once(|| cells.newest(1) > before).kill(), "{place}");
        // What a copy that is killed at its beginning leaves.
        std::fs::create_dir_all(cells.0.path("city/cells/1/copy/of-1.part")).unwrap();
        cells.0.write("city/cells/1/copy/of-1.part/LOCK", "");
    }
    // A copy that cannot be read is passed over.
    let damaged = format!("city/cells/1/copy/{}", cells.newest(1).unwrap() + 1);
    std::fs::create_dir(cells.0.path(&damaged)).unwrap();
    let (code, said) = cells.says("run city --cell 1 --spill-dir two");
    assert_eq!(code, Some(0), "{said}");
    says(&said, &[&damaged, "passed over"]);
    assert!(!cells.0.exists("city/cells/1/copy/of-1.part"));
    assert!(cells.0.ply(&run_on("two")) == alone, "the scene is another");
    says(&cells.done("merge city --out again"), &[merged.split(": ").nth(1).unwrap()]);
    // The merge of before the cell was trained again, and one whose PLY is gone.
    cells.refuses("merge city --out whole", &["trained again since"]);
    std::fs::remove_file(cells.0.path("again/point_cloud.ply")).unwrap();
    cells.refuses("merge city --out again", &["the PLY is gone"]);
    pages_of_finished_cells_go(&cells);
    // Another cell's fault hides no cell.
    cells.0.write("city/cells/0/done.toml", "junk");
    says(&cells.done("status city"), &["cell 0:", "done.toml", "cell 1:", "2 of 3 cells are done"]);
    // A run of other photos is not measured at the borders of this city.
    write_city(
        &cells.0.path("other"),
        &CityOptions { views: 8, width: 48, height: 36, ..CityOptions::default() },
        &|_, _| {},
    )
    .unwrap();
    cells.0.train("other --out of-other --steps 4 --quiet --device cpu");
    cells.refuses("seam city of-other", &["it is of", "other", "--scene"]);
}

/// A worker on a drive that never comes back leaves its pages there until the drive has work again.
fn pages_of_finished_cells_go(cells: &Cells) {
    std::fs::remove_file(cells.0.path("city/cells/2/done.toml")).unwrap();
    let committed = || cells.0.has_committed(&format!("{}/run", cells.place("two", 2)));
    let begun = || cells.0.path("two").read_dir().unwrap().count() == 2 && committed();
    cells.0.remove("city/cells/2/copy");
    let worker = cells.begin("run city --cell 2 --commit-every 0.01 --log-every 1 --spill-dir two");
    assert!(worker.once(begun).kill());
    let pages = format!("{}/pages", cells.place("two", 2));
    assert!(cells.0.exists(&pages));
    std::fs::remove_file(cells.0.path("city/cells/2/lock")).unwrap();
    cells.done("run city --cell 2");
    cells.forget(0);
    cells.done("run city --cell 0 --spill-dir two");
    assert!(!cells.0.exists(&pages), "pages of a cell that is done");
}

/// The rows of the ring are those of the prior, bit for bit.
fn ring_is_frozen(cells: &Cells, cell: usize) {
    let mut prior = StoredStart::open(&cells.0.path("city/prior/store"), GIB, 2).unwrap();
    let mut done = StoredStart::open(&cells.copy(cell), GIB, 2).unwrap();
    let print = &done.state().origin.dataset;
    let frame = (print.origin, print.scale);
    let in_prior: BTreeMap<_, _> = prior.pages().into_iter().map(|(no, id)| (id, no)).collect();
    let listed = cells.0.text(&format!("city/cells/{cell}/pages.txt"));
    let (mut frozen, mut changed) = (0, 0);
    for (no, id) in done.pages() {
        let line = listed.lines().nth((id.origin() & 0x7fff_ffff) as usize).unwrap();
        assert_eq!(line.ends_with("frozen"), id.is_frozen(), "{line}");
        let page = in_prior[&line.trim_end_matches(" frozen").parse().unwrap()];
        let (before, after) = (prior.rows_of(page, frame).unwrap(), done.rows_of(no, frame).unwrap());
        let same = before.0 == after.0
            && [Column::Means, Column::Quats, Column::Scales, Column::Opacities, Column::Sh0]
                .into_iter()
                .all(|column| before.1.column(column) == after.1.column(column));
        assert!(same || !id.is_frozen(), "page {line} has changed");
        frozen += usize::from(id.is_frozen());
        changed += usize::from(!same);
    }
    assert!(frozen > 0 && changed > 0, "{frozen} pages are frozen, {changed} have changed");
}

/// The merged scene has each row of a cell that lies in its ground, and no row of the prior twice.
fn merge_is_by_place(cells: &Cells, merged: &str) {
    let plan = cells.plan();
    let numbers =
        |value: &toml::Value| -> Vec<f64> { value.as_array().unwrap().iter().map(|x| x.as_float().unwrap()).collect() };
    let origin: [f64; 3] = numbers(&plan["origin"]).try_into().unwrap();
    let axes: Vec<Vec<f64>> = plan["axes"].as_array().unwrap().iter().map(numbers).collect();
    let frame = (origin, plan["scale"].as_float().unwrap());
    let (leaves, of_prior) = (plan["leaves"].as_array().unwrap(), plan["gaussians"].as_integer().unwrap() as u64);
    let cell_at = |mean: &[f32]| {
        let at = |axis: usize| (0..3).map(|i| axes[axis][i] * f64::from(mean[i])).sum::<f64>();
        let holds = |leaf: &&toml::Value| {
            let [low, high] = ["low", "high"].map(|end| numbers(&leaf[end]));
            (0..2).all(|axis| at(axis) >= low[axis] && at(axis) < high[axis])
        };
        leaves.iter().find(holds).unwrap()["cell"].as_integer().unwrap() as usize
    };
    let (mut uids, mut kept) = (BTreeSet::new(), 0);
    for cell in 0..3 {
        let mut store = StoredStart::open(&cells.copy(cell), GIB, 2).unwrap();
        for (no, _) in store.pages().into_iter().filter(|(_, id)| !id.is_frozen()) {
            let (of_page, columns) = store.rows_of(no, frame).unwrap();
            let own = (0..columns.rows()).filter(|&row| cell_at(columns.row(Column::Means, row)) == cell);
            kept += own.filter(|&row| of_page[row] >= of_prior || uids.insert(of_page[row])).count();
        }
    }
    let (columns, meta) = cells.0.gaussians("whole/point_cloud.ply");
    assert_eq!(meta.frame, ExportFrame::Local, "a key of the whole scene that the prior does not have");
    let put_back: usize = merged.split(" put back").next().unwrap().rsplit(' ').next().unwrap().parse().unwrap();
    assert_eq!(columns.rows(), kept + put_back, "{merged}");
    assert!(columns.rows() > 1500, "{merged}");
    assert!(cells.0.eval_psnr("whole --device cpu") > 10.0);
}

#[test]
fn a_cell_has_one_owner_and_stops_with_a_copy_and_changed_plans_are_refused() {
    let cells = Cells::cut(800, "--cells 2");
    for flags in ["--optimizer-on host", "--schedule classic", "--poor-points", "--up keep", "--appearance full"] {
        cells.refuses(&format!("run city --cell 0 {flags}"), &["it decides what is trained"]);
    }
    for flags in ["run city --cell 0 --copy-every 1e19", "seam city x --band=-1"] {
        cells.refuses(flags, &["out of range"]);
    }
    for flags in ["--margin nan", "--view-share nan", "--cells 0", "--network 0"] {
        cells.refuses(&format!("cut scene --out city --cells 2 {flags}"), &[&flags[..flags.find(' ').unwrap()]]);
    }
    let said = cells.says("cut scene --out city --dry-run --max-gaussians-per-cell 10").1;
    says(&said, &["--max-gaussians-per-cell", "10 Gaussians are too few", "give at least"]);
    // A dry run plans for a larger scene, and writes nothing.
    let plan = cells.0.text("city/plan.toml");
    let larger = "--dry-run --cells 5 --machines 3 --as-if 40000,100M,8MB,0.05";
    let said = cells.done(&format!("cut scene --out city {larger}"));
    says(&said, &["40000 training photos", "modelled", "merge"]);
    let machines = said.lines().find_map(|line| line.strip_prefix("cells ")).unwrap().split_whitespace().next();
    assert!(machines == Some("3") && cells.0.text("city/plan.toml") == plan, "{said}");
    cells.refuses("prior scene --out other --ssim-lambda 7", &["--ssim-lambda"]);
    cells.refuses("prior scene --out scene", &["is the scene itself"]);
    // A file that is missing may come: shared folders lag.
    let (code, said) = cells.says("cut scene --out other --cells 2");
    assert_eq!(code, Some(75), "{said}");
    says(&said, &["keys.toml", "gsscale-cells prior"]);
    assert!(!cells.0.exists("other"));
    // Legs of one step: most of the time the worker is between two of them.
    let worker = cells.begin("run city --cell 0 --threads 1 --copy-every 1e-6").once(|| cells.newest(0) > Some(0));
    let (code, said) = cells.says("run city --cell 0");
    assert_eq!(code, Some(76), "{said}");
    says(&said, &["another process works on cell 0"]);
    worker.signal("TERM").ends(75);
    says(&cells.done("status city"), &["cell 0:", "waiting", "0 of 2 cells are done"]);
    // What this machine lacks, another one may have.
    std::fs::rename(cells.0.scene(), cells.0.path("away")).unwrap();
    assert_eq!(cells.says("run city --cell 0").0, Some(75));
    std::fs::rename(cells.0.path("away"), cells.0.scene()).unwrap();
    assert_eq!(cells.says("run city --cell 0 --host-mem 1MiB").0, Some(75));
    // A worker that was taken for lost gives its copy no name.
    let before = cells.newest(0);
    let worker = cells.begin("run city --cell 0 --threads 1 --copy-every 1e-6").once(|| cells.newest(0) > before);
    let worker = worker.signal("STOP");
    cells.0.write("city/cells/0/lock", "another process 1 of another machine");
    says(&worker.signal("CONT").ends(76), &["another process has taken cell 0 over", "another machine"]);
    std::fs::remove_file(cells.0.path("city/cells/0/lock")).unwrap();
    cells.refuses("merge city --out whole", &["cells 0, 1 are not done"]);
    for (file, from, to) in [("plan.toml", "steps = ", "steps = 1"), ("cells/1/pages.txt", "\n", " frozen\n")] {
        let file = format!("city/{file}");
        let before = cells.0.text(&file);
        cells.0.write(&file, before.replacen(from, to, 1));
        cells.refuses("run city --cell 1", &["was changed after the cut"]);
        cells.0.write(&file, before);
    }
    // The only steps of a cell, in a store that cannot be read.
    std::fs::create_dir(cells.0.path("pages")).unwrap();
    let flags = "run city --cell 1 --spill-dir pages";
    let has_logged = || {
        let mut runs = std::fs::read_dir(cells.0.path("pages")).unwrap();
        runs.any(|run| cells.0.lines(run.unwrap().path().join("run").to_str().unwrap()) > 30)
    };
    assert!(cells.begin(&format!("{flags} --commit-every 0.01 --log-every 1")).once(has_logged).kill());
    let store = format!("{}/pages", cells.place("pages", 1));
    cells.0.write(&cells.only(&store, "witness"), "");
    let (code, said) = cells.says(flags);
    assert!(code != Some(0) && cells.0.exists(&format!("{store}/FORMAT")), "{code:?}: {said}");
    cells.refuses("cut scene --out city --cells 3", &["the city is cut already"]);
    says(&cells.done("cut scene --out city --cells 2"), &["is cut", "2 cells"]);
}

/// A worker that is killed before its first step marks its folder. The mark is nothing to go on from once another one has copied a commit.
#[test]
fn a_cell_whose_worker_was_killed_before_its_first_step_goes_on_from_the_copy() {
    let cells = Cells::cut(800, "--cells 1");
    cells.refuses("run city --cell 0 --frames 100", &["--frames", "--spill-dir"]);
    ["one", "two"].iter().for_each(|drive| std::fs::create_dir(cells.0.path(drive)).unwrap());
    let marked = || {
        cells.0.exists("one")
            && cells
                .0
                .path("one")
                .read_dir()
                .unwrap()
                .next()
                .is_some_and(|place| place.unwrap().path().join("run/.gsscale-begun.toml").exists())
    };
    assert!(cells.begin("run city --cell 0 --spill-dir one").once(marked).kill());
    let mark = format!("{}/run/.gsscale-begun.toml", cells.place("one", 0));
    std::fs::remove_file(cells.0.path("city/cells/0/lock")).unwrap();
    let worker = cells.begin("run city --cell 0 --spill-dir two --threads 1 --copy-every 1e-6");
    worker.once(|| cells.newest(0).is_some()).signal("TERM").signal("TERM").ends(75);
    let copied = cells.newest(0);
    assert!(cells.0.exists(&mark), "the first worker left no mark");
    let worker = cells.begin("run city --cell 0 --spill-dir one --threads 1 --copy-every 1e-6");
    worker.once(|| cells.newest(0) > copied).signal("TERM").ends(75);
    assert!(!cells.0.exists(&mark));
}

/// Without a cap the prior decides the number, and cells of photos as small as its own add none.
#[test]
fn a_city_without_a_cap_has_the_count_of_its_prior() {
    let cells = Cells(Workdir::wide_city(3000));
    cells.done("prior scene --out city --steps 160 --page-rows 32");
    cells.done("cut scene --out city --cells 2");
    assert_eq!(cells.plan()["growth"].as_float(), Some(1.0));
}

#[test]
fn cells_with_few_photos_or_none_are_joined_to_a_neighbour() {
    let cells = Cells::cut(40, "--cells 16 --view-share 0.6");
    let plan = cells.plan();
    let of = |cell: &toml::Value| cell["train_views"].as_integer().unwrap();
    let views: Vec<i64> = plan["cells"].as_array().unwrap().iter().map(of).collect();
    assert!(cells.count() < 16 && views.iter().all(|&views| views >= 8 || cells.count() == 1), "{views:?}");
    // All photos have a cell, and all of the ground has one.
    let names = (0..cells.count()).flat_map(|cell| {
        let names = cells.0.text(&format!("city/cells/{cell}/views.txt"));
        names.lines().map(str::to_string).collect::<Vec<_>>()
    });
    assert_eq!(names.collect::<BTreeSet<_>>().len(), cells.0.photos().len());
    assert_eq!(plan["leaves"].as_array().unwrap().len(), 16);
    cells.0.write("none.txt", "\n");
    cells.0.refuses("scene --out x --views-file none.txt", &["none.txt", "it lists no photo"]);
    // However short its legs are, a cell is evaluated and done.
    // 0 is one leg.
    for (cell, every) in [(0, "1e-6"), (1, "0")] {
        cells.done(&format!("run city --cell {cell} --copy-every {every}"));
        let done: toml::Table = cells.0.text(&format!("city/cells/{cell}/done.toml")).parse().unwrap();
        assert!(done["psnr"].as_float().is_some_and(|psnr| psnr > 5.0), "{done:?}");
    }
}
