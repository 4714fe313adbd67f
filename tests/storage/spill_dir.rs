//! A spill directory belongs to one process of one user, and foreign files in it stay untouched.
//!
//! Some tests start this program a second time, to run [`second_process`].

use crate::support::child::one_test;
use gsscale::base::error::InputError;
use gsscale::base::ids::PageId;
use gsscale::page::engine::buffer::PageBuffer;
use gsscale::page::engine::page_engine::Place;
use gsscale::page::engine::segment_files::{SegmentFiles, segment_file_name};
use gsscale::page::folder::spill_dir::SpillDir;
use gsscale::page::format::slot_header::{HEADER_BYTES, SlotHeader, SlotRef, StoredAs};
use gsscale::page::versions::slots::SlotLayout;
use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::fs::{FileExt, MetadataExt, PermissionsExt, chown, symlink};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

const LAYOUT: SlotLayout = SlotLayout { slot_bytes: 8192, slots_per_segment: 4 };
const NOBODY: u32 = 65534;

fn create(folder: &Path) -> Result<SpillDir, InputError> {
    SpillDir::create(folder, LAYOUT, false)
}

fn is_root() -> bool {
    rustix::process::geteuid().is_root()
}

/// Every file below a folder with its bytes, to compare before and after.
fn contents(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let bytes = if path.is_file() { std::fs::read(&path).unwrap() } else { Vec::new() };
        files.insert(path, bytes);
    }
    files
}

/// Asserts that the folder is refused with `words` and a remedy, and that nothing in it changed.
fn assert_refused(folder: &Path, words: &str) {
    let before = contents(folder);
    let error = create(folder).expect_err("taken");
    let told = error.to_string();
    assert!(told.contains(words) && !error.remedy.is_empty(), "{told}");
    assert!(contents(folder) == before, "something in the folder changed");
}

fn write_segment(folder: &Path, segment: u32, store: u128) {
    let place = Place { segment, offset: 0 };
    let slot = SlotRef { place, stored_bytes: 1, payload_bytes: 1, generation: 1, checksum: 0, codec: StoredAs::Raw };
    let mut header = [0; HEADER_BYTES];
    SlotHeader { store, page: PageId::initial(0), serial: 0, slot, label: Vec::new() }.encode(&mut header);
    std::fs::write(folder.join(segment_file_name(segment)), header).unwrap();
}

#[test]
fn a_clean_end_leaves_nothing_behind() {
    let parent = tempfile::tempdir().unwrap();
    for exists in [false, true] {
        let folder = parent.path().join(format!("spill{exists}"));
        if exists {
            std::fs::create_dir(&folder).unwrap();
        }
        let spill = create(&folder).unwrap();
        let mut files = SegmentFiles::new(spill.folder(), true).unwrap();
        files.create(0, LAYOUT.segment_bytes()).unwrap();
        files.create(1, LAYOUT.segment_bytes()).unwrap();
        write_segment(&folder, 2, spill.format().store);
        assert_eq!(spill.segments().unwrap(), [0, 1, 2]);
        assert!(spill.free_bytes().unwrap().is_some_and(|bytes| bytes > 0));
        assert_eq!(spill.remove().unwrap(), [""; 0]);
        assert_eq!(folder.exists(), exists, "only a folder that was made is removed");
        assert!(!exists || contents(&folder).is_empty());
    }
}

#[test]
fn removal_keeps_foreign_files() {
    let parent = tempfile::tempdir().unwrap();
    let folder = parent.path().join("spill");
    let outside = parent.path().join("outside");
    std::fs::write(&outside, b"mine").unwrap();
    let spill = create(&folder).unwrap();
    write_segment(&folder, 0, spill.format().store);
    write_segment(&folder, 1, spill.format().store + 1);
    std::fs::write(folder.join(segment_file_name(2)), b"mine, by chance of that name").unwrap();
    symlink(&outside, folder.join(segment_file_name(3))).unwrap();
    std::fs::write(folder.join("notes.txt"), b"mine").unwrap();
    std::fs::create_dir(folder.join(segment_file_name(4))).unwrap();
    // As a kill leaves a segment between the file and its space.
    std::fs::write(folder.join(segment_file_name(5)), b"").unwrap();
    let kept = spill.remove().unwrap();
    let ours: Vec<String> = (1..5).map(segment_file_name).collect();
    assert_eq!(kept, [["notes.txt".to_string()].as_slice(), &ours].concat());
    let left: Vec<PathBuf> = contents(&folder).into_keys().collect();
    assert_eq!(left, kept.iter().map(|name| folder.join(name)).collect::<Vec<_>>());
    assert_eq!(std::fs::read(&outside).unwrap(), b"mine");
}

/// Somebody removes the folder in use, and another run creates its own in the same place.
#[test]
fn a_store_that_replaced_ours_is_not_removed() {
    let parent = tempfile::tempdir().unwrap();
    let folder = parent.path().join("spill");
    let ours = create(&folder).unwrap();
    std::fs::remove_dir_all(&folder).unwrap();
    let theirs = create(&folder).unwrap();
    write_segment(&folder, 0, theirs.format().store);
    let before = contents(&folder);
    let error = ours.remove().unwrap_err();
    assert!(error.problem.contains("another store has replaced"), "{error}");
    assert!(contents(&folder) == before);
    assert_eq!(theirs.remove().unwrap(), [""; 0]);
}

#[test]
fn folders_of_something_else_are_refused_and_untouched() {
    let parent = tempfile::tempdir().unwrap();
    let folder = |name: &str| {
        let folder = parent.path().join(name);
        std::fs::create_dir(&folder).unwrap();
        folder
    };
    let full = folder("full");
    std::fs::write(full.join("photo.jpg"), b"mine").unwrap();
    assert_refused(&full, "it is neither empty nor a spill directory (it contains \"photo.jpg\")");
    let format = folder("format");
    std::fs::write(format.join("FORMAT"), b"of another program").unwrap();
    assert_refused(&format, "not the FORMAT file of a spill directory");
    assert!(SpillDir::open(&format, false).unwrap_err().to_string().contains("not the FORMAT file"));
    let lock = folder("lock");
    std::fs::write(lock.join("LOCK"), b"of another program").unwrap();
    assert_refused(&lock, "this LOCK file is not from gsscale");
    let pipe = folder("pipe");
    let made = Command::new("mkfifo").arg(pipe.join("LOCK")).status();
    assert!(made.unwrap().success(), "mkfifo");
    assert_refused(&pipe, "this LOCK file is not from gsscale");
    let links = folder("links");
    symlink(full.join("photo.jpg"), links.join("FORMAT")).unwrap();
    assert_refused(&links, "reading failed");
    std::fs::remove_file(links.join("FORMAT")).unwrap();
    symlink(full.join("photo.jpg"), links.join("LOCK")).unwrap();
    assert_refused(&links, "locking the spill directory failed");
    assert_eq!(std::fs::read(full.join("photo.jpg")).unwrap(), b"mine");
    // Open creates nothing.
    let empty = folder("empty");
    assert!(SpillDir::open(&empty, false).unwrap_err().to_string().contains("it has no FORMAT file"));
    assert!(contents(&empty).is_empty());
}

#[test]
fn links_and_files_and_missing_parents_are_refused() {
    let parent = tempfile::tempdir().unwrap();
    let (real, link, file) = (parent.path().join("real"), parent.path().join("link"), parent.path().join("file"));
    std::fs::create_dir(&real).unwrap();
    symlink(&real, &link).unwrap();
    std::fs::write(&file, b"mine").unwrap();
    let error = |folder: &Path| create(folder).unwrap_err().to_string();
    assert!(error(&link).contains("is a symbolic link"));
    symlink(parent.path().join("nowhere"), parent.path().join("dangling")).unwrap();
    assert!(error(&parent.path().join("dangling")).contains("is a symbolic link"));
    assert!(error(&file).contains("is not a folder"));
    // A missing mount must not become a folder on the drive below.
    assert!(error(&parent.path().join("nowhere/spill")).contains("make that folder first"));
    assert!(contents(&real).is_empty() && !parent.path().join("nowhere").exists());
}

#[test]
fn left_over_directories_are_refused_with_the_remedy() {
    let parent = tempfile::tempdir().unwrap();
    let folder = parent.path().join("spill");
    drop(create(&folder).unwrap());
    assert_refused(&folder, "it holds the checkpoint of another run");
    assert!(create(&folder).unwrap_err().remedy.contains("rm -r"));
    let kept = parent.path().join("kept");
    let store = SpillDir::create(&kept, LAYOUT, false).unwrap().format().store;
    assert_refused(&kept, "it holds the checkpoint of another run");
    let opened = SpillDir::open(&kept, false).unwrap();
    assert_eq!((opened.format().store, opened.format().layout), (store, LAYOUT));
    drop(opened);
    let path = kept.join("FORMAT");
    let mut bytes = std::fs::read(&path).unwrap();
    bytes[20] ^= 4;
    for (what, bytes) in [("damaged", &bytes[..]), ("cut", &bytes[..20]), ("empty", &[])] {
        std::fs::write(&path, bytes).unwrap();
        assert!(SpillDir::open(&kept, false).is_err() && create(&kept).is_err(), "{what}");
    }
    // A process that ended between its first two files leaves a usable folder.
    let begun = parent.path().join("begun");
    drop(create(&begun).unwrap());
    std::fs::rename(begun.join("FORMAT"), begun.join("FORMAT.new")).unwrap();
    assert!(create(&begun).is_ok());
}

#[test]
fn folders_of_or_open_to_others_are_refused() {
    let parent = tempfile::tempdir().unwrap();
    let open = parent.path().join("open");
    std::fs::create_dir(&open).unwrap();
    let may = |mode: u32| std::fs::set_permissions(&open, std::fs::Permissions::from_mode(mode)).unwrap();
    may(0o777);
    drop(create(&open).unwrap());
    assert_eq!(open.metadata().unwrap().mode() & 0o777, 0o700, "an empty folder becomes private");
    may(0o770);
    assert!(SpillDir::open(&open, false).unwrap_err().to_string().contains("other users have write permission"));
    let foreign = if is_root() {
        let folder = parent.path().join("foreign");
        std::fs::create_dir(&folder).unwrap();
        chown(&folder, Some(NOBODY), None).unwrap();
        folder
    } else {
        PathBuf::from("/") // root's
    };
    assert!(create(&foreign).unwrap_err().to_string().contains("belongs to another user"));
}

#[test]
fn a_spill_directory_in_memory_is_warned_about() {
    let memory = Path::new("/dev/shm");
    let mounts = std::fs::read_to_string("/proc/mounts").unwrap_or_default();
    if !mounts.contains(" /dev/shm tmpfs ") {
        eprintln!("not run: there is no tmpfs at /dev/shm");
        return;
    }
    let parent = tempfile::tempdir_in(memory).unwrap();
    let spill = create(&parent.path().join("spill")).unwrap();
    assert!(spill.warnings()[0].contains("take memory"), "{:?}", spill.warnings());
    // With or without direct I/O (tmpfs of this kernel may refuse it), segments work.
    let mut files = SegmentFiles::new(spill.folder(), true).unwrap();
    files.create(0, LAYOUT.segment_bytes()).unwrap();
    let page = PageBuffer::zeroed(8192);
    files.file_for_write(0).unwrap().write_all_at(page.as_slice(), 8192).unwrap();
    files.sync().unwrap();
    assert_eq!(spill.remove().unwrap(), [""; 0]);
}

/// The second process: `GSSCALE_TEST_ROLE` names its task, `GSSCALE_TEST_FOLDER` its folder. Without these variables
/// the test does nothing.
#[test]
fn second_process() {
    let Ok(role) = std::env::var("GSSCALE_TEST_ROLE") else { return };
    let folder = PathBuf::from(std::env::var("GSSCALE_TEST_FOLDER").unwrap());
    match role.as_str() {
        "hold" => match create(&folder) {
            Ok(_spill) => {
                say("held");
                std::io::stdin().lines().next();
            }
            Err(error) => say(&format!("refused: {}", error.problem)),
        },
        "create" => say(&create(&folder).map_or_else(|e| e.to_string(), |_| "made".to_string()).replace('\n', " ")),
        "no umask" => {
            rustix::process::umask(rustix::fs::Mode::empty());
            let spill = create(&folder).unwrap();
            SegmentFiles::new(spill.folder(), true).unwrap().create(0, 8192).unwrap();
            say("made");
        }
        other => panic!("no role {other}"),
    }
}

/// Prints a line for the first process, distinct from the output of the test runner.
fn say(line: &str) {
    println!("\nsays {line}");
    std::io::stdout().flush().unwrap();
}

fn start(role: &str, folder: &Path, change: impl FnOnce(&mut Command) -> &mut Command) -> std::io::Result<Child> {
    let mut command = one_test(module_path!(), "second_process");
    command.env("GSSCALE_TEST_ROLE", role).env("GSSCALE_TEST_FOLDER", folder);
    change(command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::null())).spawn()
}

/// Reads the line of the second process.
fn heard(child: &mut Child) -> String {
    let lines = BufReader::new(child.stdout.as_mut().unwrap()).lines();
    let said = lines.map_while(Result::ok).find_map(|line| line.strip_prefix("says ").map(str::to_string));
    said.expect("the second process ended without a word")
}

fn ask(role: &str, folder: &Path) -> String {
    let mut child = start(role, folder, |command| command).unwrap();
    let said = heard(&mut child);
    assert!(child.wait().unwrap().success());
    said
}

#[test]
fn two_processes_never_share_a_directory() {
    let parent = tempfile::tempdir().unwrap();
    let folder = parent.path().join("spill");
    let mut holder = start("hold", &folder, |command| command).unwrap();
    assert_eq!(heard(&mut holder), "held");
    let before = contents(&folder);
    for refused in [create(&folder), SpillDir::open(&folder, false)] {
        let told = refused.unwrap_err().to_string();
        let process = format!("another process uses the spill directory (process {}, host ", holder.id());
        assert!(told.contains(&process) && told.contains("remedy"), "{told}");
    }
    assert!(contents(&folder) == before);
    // The holder is killed: its lock is released, and the folder is recognized as another run's.
    holder.kill().unwrap();
    holder.wait().unwrap();
    assert_refused(&folder, "it holds the checkpoint of another run");
    let in_use = SpillDir::open(&folder, false).unwrap();
    assert!(ask("create", &folder).contains(&format!("process {}", std::process::id())));
    assert_eq!(in_use.remove().unwrap(), [""; 0]);
}

#[test]
fn of_many_racing_processes_one_wins() {
    let parent = tempfile::tempdir().unwrap();
    for round in 0..4 {
        let folder = parent.path().join(format!("spill{round}"));
        let mut racers: Vec<Child> = (0..10).map(|_| start("hold", &folder, |command| command).unwrap()).collect();
        let said: Vec<String> = racers.iter_mut().map(heard).collect();
        assert_eq!(said.iter().filter(|s| *s == "held").count(), 1, "{said:?}");
        assert!(said.iter().all(|s| s == "held" || s.contains("another process uses")), "{said:?}");
        for mut racer in racers {
            drop(racer.stdin.take());
            racer.wait().unwrap();
        }
    }
}

#[test]
fn read_only_folders_are_refused() {
    let parent = tempfile::tempdir().unwrap();
    let folder = parent.path().join("spill");
    std::fs::create_dir(&folder).unwrap();
    std::fs::set_permissions(&folder, std::fs::Permissions::from_mode(0o500)).unwrap();
    let said = if is_root() {
        // Root may write everywhere, so a process of another user tries.
        std::fs::set_permissions(parent.path(), std::fs::Permissions::from_mode(0o755)).unwrap();
        chown(&folder, Some(NOBODY), None).unwrap();
        match start("create", &folder, |command| command.uid(NOBODY).gid(NOBODY)) {
            Ok(mut child) => heard(&mut child),
            Err(error) => {
                eprintln!("not run: root cannot be refused, and nobody cannot start this program: {error}");
                return;
            }
        }
    } else {
        create(&folder).unwrap_err().to_string()
    };
    assert!(said.contains("Permission denied") && said.contains("check the permissions"), "{said}");
}

#[test]
fn files_are_private_whatever_the_umask() {
    let parent = tempfile::tempdir().unwrap();
    let folder = parent.path().join("spill");
    assert_eq!(ask("no umask", &folder), "made");
    assert_eq!(folder.metadata().unwrap().mode() & 0o777, 0o700);
    let files = contents(&folder);
    assert_eq!(files.len(), 3);
    for path in files.keys() {
        assert_eq!(path.metadata().unwrap().mode() & 0o777, 0o600, "{}", path.display());
    }
}
