//! `gsscale-ckpt`: lists, verifies, exports, imports, copies and repairs checkpoints. Parses, calls the library,
//! prints.

use clap::{Parser, Subcommand};
use gsscale::base::error::InputError;
use gsscale::base::ids::PageId;
use gsscale::base::say::{aligned, shell_word};
use gsscale::base::units::format_bytes;
use gsscale::config::command_line::parse_plain;
use gsscale::config::values::ByteSize;
use gsscale::exchange::format::ExportFormat;
use gsscale::exchange::meta::ExportFrame;
use gsscale::exchange::sink::LevelCounts;
use gsscale::exchange::transform::transform_path;
use gsscale::page::format::codec::Codec;
use gsscale::page::format::slot_header::StoredAs;
use gsscale::page::map::commit::CommitError;
use gsscale::page::map::entries::MapError;
use gsscale::train::error::TrainError;
use gsscale::train::inputs::machine::absolute;
use gsscale::train::inputs::signals::StopFlag;
use gsscale::train::stores::{
    ExportRequest, GenerationLine, ImportRequest, Inspected, PageInspected, PruneRequest, Pruned, RolledBack,
    SalvageRequest, Salvaged, StoreFault, ValueSpread, Verdict, clone_store, export, find_store, import, inspect,
    inspect_page, list, prune, rollback, salvage, verify,
};
use serde::Serialize;
use std::ffi::OsString;
use std::path::PathBuf;
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  gsscale-ckpt ls runs/village                         generations: step, PSNR, Gaussians, bytes
  gsscale-ckpt verify runs/village --deep              verifies every checksum and value; exit code 1 on damage
  gsscale-ckpt export runs/village --out village.ply   the PLY as of the last commit
  gsscale-ckpt rollback runs/village 41 --yes          the next --resume continues from generation 41
  gsscale-ckpt clone runs/village /mnt/other/village   copies the store to another drive
  gsscale-ckpt salvage runs/village --out rescued      if verify reports a damaged map

DIR is the output folder of a run, or its spill directory. ls, inspect, verify, export, clone and salvage never
write to it. `gsscale-ckpt COMMAND --help` shows examples.";

/// Lists, verifies, exports, imports, copies and repairs checkpoints.
#[derive(Parser)]
#[command(name = "gsscale-ckpt", version, after_help = EXAMPLES)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Lists generations and named checkpoints
    #[command(alias = "list")]
    Ls(Ls),
    /// Shows a store, its training state, or one page
    Inspect(Inspect),
    /// Verifies a store and lists every fault; exit code 1 if there is one
    Verify(Verify),
    /// Makes an earlier generation the latest one
    Rollback(Rollback),
    /// Removes names of checkpoints, and frees pages that only they kept
    Prune(Prune),
    /// Writes the Gaussians of a generation as a PLY, SPZ or SOG
    Export(Export),
    /// Makes a store from the Gaussians of a PLY
    Import(Import),
    /// Copies a store to another drive
    Clone(Clone),
    /// Rebuilds a damaged store elsewhere from its intact pages
    Salvage(Salvage),
}

fn main() -> ExitCode {
    run_with(std::env::args_os().collect())
}

/// The program, with the words of its command line; the first is its name.
pub fn run_with(arguments: Vec<OsString>) -> ExitCode {
    let done = match parse_plain::<Args>(&arguments).command {
        Command::Ls(args) => run_ls(&args),
        Command::Inspect(args) => run_inspect(&args),
        Command::Verify(args) => run_verify(&args),
        Command::Rollback(args) => run_rollback(&args),
        Command::Prune(args) => run_prune(&args),
        Command::Export(args) => run_export(&args),
        Command::Import(args) => run_import(&args),
        Command::Clone(args) => run_clone(&args),
        Command::Salvage(args) => run_salvage(&args),
    };
    done.unwrap_or_else(|error| {
        gsscale::tell!("error: {error}");
        if is_damaged_map(&error) {
            gsscale::tell!(
                "  remedy: gsscale-ckpt salvage DIR --out TO rebuilds the map from the pages, and never writes to DIR"
            );
        }
        match listen().ok().and_then(|stop| stop.exit_code()) {
            Some(code) => ExitCode::from(code as u8),
            None => ExitCode::FAILURE,
        }
    })
}

/// The stop request of this process. Errors: the system refused a handler.
fn listen() -> Result<StopFlag, TrainError> {
    StopFlag::listen().map_err(|e| InputError::io("signals", "listening for Ctrl-C", &e).into())
}

fn is_damaged_map(error: &TrainError) -> bool {
    use MapError::{Damaged, Panicked, Stale};
    matches!(
        error,
        TrainError::Commit(CommitError::Map(Damaged(_) | Panicked(_) | Stale { .. }) | CommitError::NoStore)
    )
}

/// Prints `value` as JSON or as text: then a command has succeeded.
fn print(json: bool, value: &impl Serialize, text: impl FnOnce() -> String) -> Result<ExitCode, TrainError> {
    let text = match json {
        true => serde_json::to_string_pretty(value)
            .map_err(|e| InputError::new("--json", format!("writing JSON failed: {e}"), "report this as a bug"))?,
        false => text(),
    };
    gsscale::say!("{}", text.trim_end_matches('\n'));
    Ok(ExitCode::SUCCESS)
}

const LS_EXAMPLES: &str = "\
Examples:
  gsscale-ckpt ls runs/village
  gsscale-ckpt ls /mnt/nvme/pages --json

'Gaussians' counts those in pages, 'at most' how many they can be after pending events: pages that no view has needed since
the last events apply them later, at an export too. 'bytes' counts all pages of a generation, 'alone' those that no other
generation needs. Works while the run trains.";

#[derive(clap::Args)]
#[command(after_help = LS_EXAMPLES)]
struct Ls {
    /// A run's output folder, or a spill directory
    dir: PathBuf,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

fn run_ls(args: &Ls) -> Result<ExitCode, TrainError> {
    let listed = list(&find_store(&args.dir)?)?;
    print(args.json, &listed, || {
        let heads = ["generation", "step", "PSNR", "Gaussians", "at most", "pages", "alone", "bytes", "names"];
        let mut rows = vec![heads.map(str::to_string).to_vec()];
        rows.extend(listed.generations.iter().map(ls_row));
        let line = |row: &Vec<String>| row.join("  ").trim_end().to_string();
        let mut text = match listed.generations.as_slice() {
            [] => "no commit yet".to_string(),
            _ => aligned(&rows).iter().map(line).collect::<Vec<_>>().join("\n"),
        };
        text += &format!("\nsegment files: {}", format_bytes(listed.segment_bytes));
        if let Some(who) = &listed.used_by {
            text += &format!("\nin use ({who}): the state shown is that of the last commit");
        }
        text
    })
}

fn ls_row(line: &GenerationLine) -> Vec<String> {
    let mut names = line.names.join(",");
    if line.is_latest {
        names = [names.as_str(), "(last)"].join(" ").trim().to_string();
    }
    vec![
        line.generation.to_string(),
        line.step.to_string(),
        line.psnr.map_or_else(|| "-".to_string(), |psnr| format!("{psnr:.2}")),
        line.gaussians.to_string(),
        line.gaussians_at_most.to_string(),
        line.pages.to_string(),
        format_bytes(line.bytes_alone),
        format_bytes(line.bytes),
        names,
    ]
}

const INSPECT_EXAMPLES: &str = "\
Examples:
  gsscale-ckpt inspect runs/village
  gsscale-ckpt inspect runs/village --generation 41
  gsscale-ckpt inspect runs/village --page 17.0 --json    the lower half of page 17: its header and its rows";

#[derive(clap::Args)]
#[command(after_help = INSPECT_EXAMPLES)]
struct Inspect {
    /// A run's output folder, or a spill directory
    dir: PathBuf,
    /// Number or name of a generation [default: the latest]
    #[arg(long, value_name = "GEN|NAME")]
    generation: Option<String>,
    /// Show this page: 17, or 17.0.1 for a part of it
    #[arg(long, value_name = "PAGE")]
    page: Option<PageId>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

fn run_inspect(args: &Inspect) -> Result<ExitCode, TrainError> {
    let place = find_store(&args.dir)?;
    match args.page {
        Some(page) => {
            let page = inspect_page(&place, args.generation.as_deref(), page)?;
            print(args.json, &page, || page_text(&page))
        }
        None => {
            let store = inspect(&place, args.generation.as_deref())?;
            print(args.json, &store, || store_text(&store))
        }
    }
}

fn store_text(s: &Inspected) -> String {
    let counted = StoredAs::ALL.iter().zip(s.pages_by_codec).map(|(form, pages)| format!("{pages} {}", form.name()));
    let codecs: Vec<String> = counted.collect();
    let [d0, d1, d2, d3] = s.pages_by_degree;
    let mut text = format!(
        "store       {} ({})\n\
         format      version {}, features {:#x} (incompatible), {:#x} (compatible)\n\
         slots       {} each, {} a segment\n\
         segments    {} files, {}\n\
         map         {} transactions\n\
         generation  {}: {} pages, {} with pending events\n\
         codec       {}; {} of payload in {}\n\
         degrees     {d0} pages with degree 0, {d1} with 1, {d2} with 2, {d3} with 3\n",
        s.identity,
        s.store.display(),
        s.format_version,
        s.features_incompatible,
        s.features_compatible,
        format_bytes(s.slot_bytes),
        s.slots_per_segment,
        s.segments,
        format_bytes(s.segment_bytes),
        s.transactions,
        s.generation,
        s.pages,
        s.pages_behind,
        codecs.join(", "),
        format_bytes(s.payload_bytes[0]),
        format_bytes(s.payload_bytes[1]),
    );
    for (i, word) in s.state.iter().enumerate() {
        text += &format!("{:<12}{word}\n", if i == 0 { "trainer" } else { "" });
    }
    if let Some(who) = &s.used_by {
        text += &format!("in use ({who}): the state shown is that of the last commit\n");
    }
    text
}

fn page_text(p: &PageInspected) -> String {
    let spread = |s: &ValueSpread| format!("{:.4} to {:.4}, mean {:.4}", s.least, s.most, s.mean);
    let mut text = format!(
        "page        {}, since generation {}\n\
         slot        {} offset {}, write {}\n\
         payload     {}, {} bytes, {} stored, xxh3-128 {}\n\
         rows        {} with SH degree {}, {} of {} events applied\n\
         means       {:?} to {:?}, sigma at most {}\n\
         updated     step {}\n\
         moments     zero in {} rows\n\
         opacity     {}\n\
         sigma       {}\n\
         views       {} since the last round\n",
        p.page,
        p.since,
        p.file,
        p.offset,
        p.serial,
        p.codec,
        p.payload_bytes[0],
        p.payload_bytes[1],
        p.checksum,
        p.rows,
        p.sh_degree,
        p.events[0],
        p.events[1],
        p.bounds[0],
        p.bounds[1],
        p.sigma_max,
        spread(&p.stamp),
        p.rows_without_moments,
        spread(&p.opacity),
        spread(&p.sigma),
        spread(&p.views),
    );
    if let Some(fault) = &p.fault {
        text += &format!("FAULT       {fault}\n");
    }
    text
}

const VERIFY_EXAMPLES: &str = "\
Examples:
  gsscale-ckpt verify runs/village           verify the map, every state, every segment's length, every slot's header
  gsscale-ckpt verify runs/village --deep    also every page's checksum and values: reads everything
  gsscale-ckpt verify runs/village --deep --json | jq .faults

Exit code 0: intact; 1: faults, which are listed, or the store cannot be read.";

#[derive(clap::Args)]
#[command(after_help = VERIFY_EXAMPLES)]
struct Verify {
    /// A run's output folder, or a spill directory
    dir: PathBuf,
    /// Read every page: verify its checksum, and that its values are finite
    #[arg(long)]
    deep: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

fn run_verify(args: &Verify) -> Result<ExitCode, TrainError> {
    let verdict = verify(&find_store(&args.dir)?, args.deep)?;
    print(args.json, &verdict, || verify_text(&verdict, args))?;
    Ok(if verdict.faults.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn verify_text(verdict: &Verdict, args: &Verify) -> String {
    let mut text: String = verdict.faults.iter().map(|fault| fault_line(fault) + "\n").collect();
    let read = if verdict.deep { format!(", {} read", format_bytes(verdict.bytes_read)) } else { String::new() };
    let what = format!("{} generations, {} page versions{read}", verdict.generations, verdict.versions);
    text += &match verdict.faults.len() {
        0 if verdict.deep => format!("intact: {what}"),
        0 => format!("intact according to all headers: {what}; --deep reads the pages"),
        n => {
            let dir = shell_word(&args.dir);
            let salvage = format!("recover the intact pages (gsscale-ckpt salvage {dir} --out TO)");
            match verdict.faults.iter().any(|fault| fault.kind == "map") {
                // No generation can be read.
                true => format!("{n} faults: {what}\nremedy: {salvage}"),
                false => format!(
                    "{n} faults: {what}\n\
                     remedy: roll back to a generation without them (gsscale-ckpt rollback {dir} GEN), or {salvage}"
                ),
            }
        }
    };
    text
}

fn fault_line(fault: &StoreFault) -> String {
    let mut words = vec![format!("FAULT {}", fault.kind)];
    words.extend(fault.page.as_ref().map(|page| format!("page {page}")));
    words.extend(fault.generation.map(|generation| format!("generation {generation}")));
    words.extend(fault.file.as_ref().map(|file| match fault.offset {
        Some(offset) => format!("{file} offset {offset}"),
        None => file.clone(),
    }));
    format!("{}: {}", words.join(", "), fault.what)
}

const ROLLBACK_EXAMPLES: &str = "\
Examples:
  gsscale-ckpt rollback runs/village 41          prints what would be lost
  gsscale-ckpt rollback runs/village 41 --yes    then gsscale-train --resume runs/village continues from there";

#[derive(clap::Args)]
#[command(after_help = ROLLBACK_EXAMPLES)]
struct Rollback {
    /// A run's output folder, or a spill directory
    dir: PathBuf,
    /// Number or name of the generation to roll back to
    #[arg(value_name = "GEN|NAME")]
    generation: String,
    /// Do it: removes later generations and their names
    #[arg(long)]
    yes: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

fn run_rollback(args: &Rollback) -> Result<ExitCode, TrainError> {
    let done = rollback(&find_store(&args.dir)?, &args.generation, args.yes)?;
    print(args.json, &done, || rollback_text(&done))?;
    if done.is_done || done.dropped.is_empty() {
        return Ok(ExitCode::SUCCESS);
    }
    gsscale::tell!("nothing was changed\n  remedy: give --yes to roll back");
    Ok(ExitCode::FAILURE)
}

fn rollback_text(done: &RolledBack) -> String {
    let RolledBack { generation, step, dropped, dropped_names, is_done } = done;
    if dropped.is_empty() {
        return format!("generation {generation} (step {step}) is already the latest");
    }
    let list: Vec<String> = dropped.iter().map(u64::to_string).collect();
    let names = match dropped_names.as_slice() {
        [] => String::new(),
        names => format!(" with the names {}", names.join(", ")),
    };
    let list = list.join(", ");
    match is_done {
        true => format!("the store is at generation {generation} (step {step}); removed: {list}{names}"),
        false => format!("would go back to generation {generation} (step {step}) and remove: {list}{names}"),
    }
}

const PRUNE_EXAMPLES: &str = "\
Examples:
  gsscale-ckpt prune runs/village --keep 3            keep the three newest named checkpoints
  gsscale-ckpt prune runs/village step-7000           remove this one
  gsscale-ckpt prune runs/village --keep 0 --dry-run

The last two generations always stay. The run reuses slots that become free; the segment files keep
their length.";

#[derive(clap::Args)]
#[command(after_help = PRUNE_EXAMPLES)]
struct Prune {
    /// A run's output folder, or a spill directory
    dir: PathBuf,
    /// Names to remove
    #[arg(value_name = "NAME", required_unless_present = "keep")]
    names: Vec<String>,
    /// Keep this many of the newest named checkpoints
    #[arg(long, value_name = "N", conflicts_with = "names")]
    keep: Option<usize>,
    /// Only print what would be removed
    #[arg(long)]
    dry_run: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

fn run_prune(args: &Prune) -> Result<ExitCode, TrainError> {
    let request = PruneRequest { names: args.names.clone(), keep: args.keep, dry_run: args.dry_run };
    let pruned = prune(&find_store(&args.dir)?, &request)?;
    print(args.json, &pruned, || prune_text(&pruned))
}

fn prune_text(pruned: &Pruned) -> String {
    let list = |numbers: &[u64]| match numbers {
        [] => "none".to_string(),
        numbers => numbers.iter().map(u64::to_string).collect::<Vec<_>>().join(", "),
    };
    if pruned.dropped_names.is_empty() {
        return format!("no name to remove; kept generations: {}", list(&pruned.kept));
    }
    let (names, removed) = (pruned.dropped_names.join(", "), list(&pruned.dropped));
    match pruned.is_done {
        true => format!(
            "removed names: {names}; removed generations: {removed}; kept: {}; {} free for the run",
            list(&pruned.kept),
            format_bytes(pruned.bytes_freed)
        ),
        false => {
            format!("would remove names: {names}; would remove generations: {removed}; kept: {}", list(&pruned.kept))
        }
    }
}

const EXPORT_EXAMPLES: &str = "\
Examples:
  gsscale-ckpt export runs/city --out city.ply
  gsscale-ckpt export runs/city --generation 41 --out then.ply
  gsscale-ckpt export runs/city --out city.spz
  gsscale-ckpt export runs/city --out city/lod-meta.json
  gsscale-ckpt export runs/city --out small.ply --max-gaussians 2000000 --sh-degree 1
  gsscale-ckpt export runs/city --out block.ply --crop 350,120,-5,420,190,60
  gsscale-ckpt export runs/city --out city.ply --host-mem 256MiB

Pages are read one by one: --host-mem bounds the memory for a scene of any size. Without --max-gaussians, --crop
and --sh-degree the file is the one that gsscale-train --export-clean=off would have written after that step.";

#[derive(clap::Args)]
#[command(after_help = EXPORT_EXAMPLES)]
struct Export {
    /// A run's output folder, or a spill directory
    dir: PathBuf,
    #[arg(long, short, value_name = "FILE", help = format!("The file to write; its name says the format: {}", ExportFormat::NAMES))]
    out: PathBuf,
    /// Number or name of a generation [default: the latest]
    #[arg(long, value_name = "GEN|NAME")]
    generation: Option<String>,
    /// Export only this many Gaussians, those that can cover the most of a picture
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    max_gaussians: Option<u64>,
    /// Export only Gaussians whose means are in this box of dataset coordinates
    #[arg(long, value_name = "MINX,MINY,MINZ,MAXX,MAXY,MAXZ", value_parser = parse_box, allow_hyphen_values = true)]
    crop: Option<[f64; 6]>,
    /// Export only spherical harmonics up to this degree
    #[arg(long, value_name = "0..3", value_parser = clap::value_parser!(u8).range(0..=3))]
    sh_degree: Option<u8>,
    /// Positions of the file: dataset, or local (near the origin, with a file that leads back) [default: that of the run]
    #[arg(long, value_name = "FRAME")]
    export_frame: Option<ExportFrame>,
    /// Most memory to use
    #[arg(long, default_value = "1GiB", value_name = "SIZE")]
    host_mem: ByteSize,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

fn parse_box(text: &str) -> Result<[f64; 6], String> {
    let wrong = || format!("'{text}' is not a box; write minx,miny,minz,maxx,maxy,maxz");
    let values: Result<Vec<f64>, _> = text.split(',').map(|v| v.trim().parse()).collect();
    let corners: [f64; 6] = values.map_err(|_| wrong())?.try_into().map_err(|_| wrong())?;
    let is_box = corners.iter().all(|x| x.is_finite()) && (0..3).all(|i| corners[i] <= corners[3 + i]);
    if is_box { Ok(corners) } else { Err(wrong() + ", each min at most its max") }
}

fn run_export(args: &Export) -> Result<ExitCode, TrainError> {
    let request = ExportRequest {
        generation: args.generation.clone(),
        out: args.out.clone(),
        host_mem: args.host_mem.0,
        max_gaussians: args.max_gaussians,
        crop: args.crop,
        sh_degree: args.sh_degree,
        frame: args.export_frame,
    };
    let done = export(&find_store(&args.dir)?, &request, &listen()?)?;
    done.warnings.iter().for_each(|warning| gsscale::tell!("warning: {warning}"));
    print(args.json, &done, || {
        let mut text = format!(
            "{}: {} Gaussians as of generation {} (step {}), {}; {} of pages read, at most {} of memory used\n",
            done.file.display(),
            done.gaussians,
            done.generation,
            done.step,
            format_bytes(done.bytes),
            format_bytes(done.bytes_read),
            format_bytes(done.host_bytes_peak),
        );
        if let Some(rows) = done.levels {
            text += &format!("{}\n", LevelCounts { rows, always_shown: done.always_shown });
        }
        if done.is_local {
            let transform = transform_path(&done.file);
            text += &format!("positions are local: {} leads back to the dataset's\n", transform.display());
        }
        if done.skipped > 0 {
            text +=
                &format!("{} Gaussians are not finite, or too far for the format, and were left out\n", done.skipped);
        }
        text
    })
}

const IMPORT_EXAMPLES: &str = "\
Examples:
  gsscale-ckpt import city.ply --out /mnt/nvme/city
  gsscale-ckpt import city.ply --out /mnt/nvme/city --host-mem 512MiB --page-rows 512
  gsscale-train scans/city --out runs/city --init-ply /mnt/nvme/city --spill-dir /mnt/nvme/pages
  gsscale-ckpt export /mnt/nvme/city --out block.ply --crop 0,0,0,10,10,10

The file may be larger than memory. Its values of 32 bits are kept bit for bit; moments are zero. gsscale-train starts from the
store with --init-ply.";

#[derive(clap::Args)]
#[command(after_help = IMPORT_EXAMPLES)]
struct Import {
    /// A PLY of Gaussians
    #[arg(value_name = "FILE.ply")]
    file: PathBuf,
    /// The store to make: a folder that does not exist yet
    #[arg(long, short, value_name = "DIR")]
    out: PathBuf,
    /// Most memory to use
    #[arg(long, default_value = "1GiB", value_name = "SIZE")]
    host_mem: ByteSize,
    /// Gaussians per page
    #[arg(long, default_value_t = 1024, value_name = "N", value_parser = clap::value_parser!(u32).range(16..=65_536))]
    page_rows: u32,
    #[arg(long, default_value = "raw", value_name = "CODEC")]
    #[arg(help = format!("Codec of the pages: {}", Codec::WORDS.join(", ")))]
    spill_codec: Codec,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

fn run_import(args: &Import) -> Result<ExitCode, TrainError> {
    let request = ImportRequest {
        file: args.file.clone(),
        out: args.out.clone(),
        host_mem: args.host_mem.0,
        page_rows: args.page_rows,
        codec: args.spill_codec,
    };
    let done = import(&request, &listen()?)?;
    print(args.json, &done, || {
        let mut text = format!(
            "{}: {} Gaussians with SH degree {} in {} pages, at most {} of memory used\n",
            done.store.display(),
            done.gaussians,
            done.sh_degree,
            done.pages,
            format_bytes(done.host_bytes_peak),
        );
        if done.dropped > 0 {
            text += &format!("{} Gaussians are not finite and were left out\n", done.dropped);
        }
        text
    })
}

const CLONE_EXAMPLES: &str = "\
Examples:
  gsscale-ckpt clone runs/village /mnt/other/village
  gsscale-train --resume runs/village --spill-dir /mnt/other/village    resumes from the copy

The copy has all kept generations with their names and numbers, and only the slots they need. Every page read is verified.";

#[derive(clap::Args)]
#[command(after_help = CLONE_EXAMPLES)]
struct Clone {
    /// A run's output folder, or a spill directory
    dir: PathBuf,
    /// The copy: a folder that does not exist yet
    to: PathBuf,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

fn run_clone(args: &Clone) -> Result<ExitCode, TrainError> {
    let done = clone_store(&find_store(&args.dir)?, &args.to, &listen()?)?;
    print(args.json, &done, || {
        format!(
            "{}: {} generations, {} page versions, {} read and verified\n\
             continue from the copy: gsscale-train --resume OUT --spill-dir {}",
            done.to.display(),
            done.generations.len(),
            done.versions,
            format_bytes(done.bytes_read),
            shell_word(absolute(&done.to)),
        )
    })
}

const SALVAGE_EXAMPLES: &str = "\
Examples:
  gsscale-ckpt salvage runs/village --out /mnt/other/rescued
  gsscale-ckpt salvage /mnt/nvme/pages --out rescued --config runs/village/config.toml
  gsscale-ckpt export rescued --out rescued.ply

If the map is intact, damaged pages are replaced by their newest older versions, and gsscale-train --resume OUT
--spill-dir TO continues. If the map is lost, the newest intact version of every page is taken: a scene to export or to
start from. Missing pages are listed. DIR is never written.";

#[derive(clap::Args)]
#[command(after_help = SALVAGE_EXAMPLES)]
struct Salvage {
    /// A run's output folder, or a spill directory
    dir: PathBuf,
    /// The new store: a folder that does not exist yet
    #[arg(long, short, value_name = "TO")]
    out: PathBuf,
    /// config.toml of the run, if the map is lost and DIR is the spill directory
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

fn run_salvage(args: &Salvage) -> Result<ExitCode, TrainError> {
    let request = SalvageRequest { to: args.out.clone(), config: args.config.clone() };
    let done = salvage(&find_store(&args.dir)?, &request, &listen()?)?;
    print(args.json, &done, || salvage_text(&done))
}

fn salvage_text(done: &Salvaged) -> String {
    let mut text = String::new();
    for page in &done.lost {
        let rows = page.rows.map_or(String::new(), |rows| format!(" of {rows} Gaussians"));
        let taken = match page.taken {
            Some(generation) => format!("its version of generation {generation} was taken"),
            None => "the page is lost".to_string(),
        };
        text += &format!("page {}{rows}: {}; {taken}\n", page.page, page.what);
    }
    done.notes.iter().for_each(|note| text += &format!("{note}\n"));
    text += &format!(
        "{}: {} Gaussians in {} pages, step {}; {} pages are missing, incomplete or older",
        done.to.display(),
        done.gaussians,
        done.pages,
        done.step,
        done.lost.len(),
    );
    text
}
