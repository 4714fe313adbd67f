//! House rules that the compiler does not hold: which layer may name which, how long functions and files are, where `unsafe`
//! may stand, and that no marker of unfinished work is left.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// For each layer, the layers that it may name (itself always).
const LAYERS: &[(&str, &str)] = &[
    ("base", ""),
    ("scene", "base"),
    ("dataset", "base scene"),
    ("poses", "base dataset"),
    ("schedule", "base scene"),
    ("page", "base"),
    ("paging", "base scene page schedule"),
    ("checkpoint", "base scene page paging densify photos"),
    ("gpu", "base"),
    ("kernels", "base scene"),
    ("optim", "base scene"),
    ("photos", "base scene dataset page kernels"),
    ("densify", "base scene optim"),
    ("render", "base scene gpu kernels"),
    ("exchange", "base scene"),
    ("report", "base dataset photos"),
    ("config", "base scene dataset schedule kernels optim densify photos gpu render exchange page paging checkpoint"),
    (
        "train",
        "base scene dataset schedule page paging checkpoint kernels optim densify photos gpu render exchange report config",
    ),
    ("cells", "base scene dataset page paging photos densify render exchange report config train"),
];

/// For each room of src/train, the rooms that it may name.
const TRAIN_ROOMS: &[(&str, &str)] = &[
    ("error", ""),
    ("inputs", "error"),
    ("step", "error"),
    ("log", "step"),
    ("memory", "step"),
    ("state", "error log memory step"),
    ("commits", "error inputs log state"),
    ("stores", "commits error inputs memory step"),
    ("start", "commits error inputs memory step stores"),
    ("preflight", "commits error inputs log memory start state step"),
    ("run", "commits error inputs log memory preflight start state step stores"),
];

/// Rooms of src/train that may name `TrainConfig`, as src/cells may, which starts runs: past them, each function takes the settings that it uses.
const START_UP_ROOMS: &[&str] = &["inputs", "preflight", "run", "start", "stores"];

/// Types whose own methods stand in several files of a top folder: to become none.
const SPREAD_TYPES: &[&str] = &["gpu Gpu", "scene Columns"];

/// Names that several types of src have: to become fewer.
const SHARED_TYPE_NAMES_MAX: usize = 12;

/// Files that may hold `unsafe`, each block with its argument.
const UNSAFE_FILES: &[&str] = &[
    "src/base/allocator.rs",
    "src/base/environment.rs",
    "src/base/simd.rs",
    "src/page/engine/mmap.rs",
    "src/page/engine/registered.rs",
    "src/page/engine/uring.rs",
    "src/poses/program.rs",
    "src/train/inputs/signals.rs",
    "tools/gpu_meter/compile.rs",
];

// Limits are for attention: far above what reads well, so that nothing is split to obey them.
const FUNCTION_LINES_MAX: usize = 120;
const FILE_LINES_MAX: usize = 900;
const README_WORDS_MAX: usize = 1300;

fn rust_files(folders: &[&str]) -> Vec<(String, String)> {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let mut files = Vec::new();
    let mut stack: Vec<PathBuf> = folders.iter().map(|f| root.join(f)).collect();
    while let Some(path) = stack.pop() {
        if path.is_dir() {
            stack.extend(std::fs::read_dir(&path).unwrap().map(|e| e.unwrap().path()));
        } else if path.extension().is_some_and(|e| e == "rs") {
            let name = path.strip_prefix(&root).unwrap().to_string_lossy().into_owned();
            files.push((name, std::fs::read_to_string(&path).unwrap()));
        }
    }
    files.sort();
    assert!(!files.is_empty());
    files
}

fn without_comments(text: &str) -> String {
    text.lines().filter(|l| !l.trim_start().starts_with("//")).collect::<Vec<_>>().join("\n")
}

/// A source text without its comment lines and its tests, which stand at its end.
fn code_of(text: &str) -> String {
    let code = without_comments(text);
    code.split("\n#[cfg(test)]").next().unwrap_or("").to_string()
}

/// Adds the paths of the tree `text` begins with (`a::{b, c::{d, e}}` is `a::b`, `a::c::d`, `a::c::e`); gives its length.
fn read_tree(text: &str, stem: &str, paths: &mut Vec<String>) -> usize {
    let is_path = |c: char| c.is_alphanumeric() || "_:".contains(c);
    let mut at = text.find(|c| !is_path(c)).unwrap_or(text.len());
    let path = format!("{stem}{}", &text[..at]);
    if !text[at..].starts_with('{') {
        paths.push(path);
        return at;
    }
    while let Some(next) = text[at..].find(|c| is_path(c) || c == '}').filter(|n| !text[at + n..].starts_with('}')) {
        at += next;
        at += read_tree(&text[at..], &path, paths);
    }
    at + text[at..].find('}').map_or(0, |end| end + 1)
}

/// Paths from the root of the crate that file `name` names through `crate::` and `super::`.
fn named_paths(name: &str, code: &str) -> Vec<Vec<String>> {
    let module = name.trim_start_matches("src/").trim_end_matches(".rs").trim_end_matches("/mod");
    let (mut paths, mut at) = (Vec::new(), 0);
    while let Some(next) = ["crate::", "super::"].iter().filter_map(|root| code[at..].find(root)).min() {
        at += next;
        at += read_tree(&code[at..], "", &mut paths);
    }
    let absolute = |path: String| {
        let mut from: Vec<String> = module.split('/').map(str::to_string).collect();
        for part in path.split("::") {
            match part {
                "crate" => from.clear(),
                "super" => drop(from.pop()),
                part => from.push(part.to_string()),
            }
        }
        from
    };
    paths.into_iter().map(absolute).collect()
}

#[test]
fn dependencies_point_one_way() {
    let allowed: BTreeMap<&str, &str> = LAYERS.iter().copied().collect();
    let mut wrong = Vec::new();
    for (name, text) in rust_files(&["src"]) {
        let Some(layer) = Path::new(&name).components().nth(1) else { continue };
        let layer = layer.as_os_str().to_string_lossy().into_owned();
        if layer == "lib.rs" {
            continue;
        }
        let allowed = allowed.get(layer.as_str()).unwrap_or_else(|| panic!("{name}: folder {layer} has no layer"));
        for used in named_paths(&name, &without_comments(&text)).iter().map(|path| path[0].as_str()) {
            if used != layer
                && LAYERS.iter().any(|(layer, _)| used == *layer)
                && !allowed.split(' ').any(|layer| layer == used)
            {
                wrong.push(format!("{name} names {used}"));
            }
        }
    }
    assert!(wrong.is_empty(), "these point the wrong way:\n{}", wrong.join("\n"));
}

/// An order that forbids circles: a room may name only rooms above it in the table.
#[test]
fn rooms_of_train_have_an_order() {
    let mut wrong = Vec::new();
    for (at, (room, may)) in TRAIN_ROOMS.iter().enumerate() {
        let below = |name: &&str| !TRAIN_ROOMS[..at].iter().any(|(room, _)| room == name);
        wrong.extend(
            may.split_terminator(' ')
                .filter(below)
                .map(|name| format!("the table has {room} name {name}, not above it")),
        );
    }
    for (name, text) in rust_files(&["src"]) {
        let code = code_of(&text);
        let inside = name.strip_prefix("src/train/").map(|rest| rest.split(['/', '.']).next().unwrap());
        let is_start_up = inside.is_some_and(|room| START_UP_ROOMS.contains(&room));
        let is_above = ["src/config/", "src/cells/"].iter().any(|folder| name.starts_with(folder));
        if !is_start_up && !is_above && code.contains("TrainConfig") {
            wrong.push(format!("{name} names TrainConfig"));
        }
        let Some(room) = inside.filter(|room| *room != "mod") else { continue };
        let known = TRAIN_ROOMS.iter().find(|(known, _)| *known == room);
        let (_, may) = known.unwrap_or_else(|| panic!("{name}: {room} is not in TRAIN_ROOMS"));
        let paths = named_paths(&name, &code).into_iter().filter(|path| path[0] == "train" && path.len() > 1);
        let others = paths
            .map(|path| path[1].clone())
            .filter(|other| other != room && !may.split(' ').any(|name| name == other));
        wrong.extend(others.map(|other| format!("{name} names train::{other}")));
    }
    assert!(wrong.is_empty(), "these name what they may not:\n{}", wrong.join("\n"));
}

fn rooms() -> Vec<String> {
    let names = rust_files(&["src"]).into_iter().map(|(name, _)| name);
    let folder = |name: String| Some(Path::new(name.strip_prefix("src/")?).parent()?.to_str()?.to_string());
    let mut rooms: Vec<String> = names.filter_map(folder).filter(|room| !room.is_empty()).collect();
    rooms.dedup();
    rooms
}

/// Files of a room (a folder in it counts as one) that a file of the room names, tests left out.
fn imported_files(room: &str, name: &str, text: &str) -> Vec<String> {
    let room: Vec<&str> = room.split('/').collect();
    let paths = named_paths(name, &code_of(text)).into_iter();
    paths
        .filter(|path| path.len() > room.len() && path[..room.len()] == room)
        .map(|mut p| p.remove(room.len()))
        .collect()
}

/// The files from `at` back to `at`, if there is such a way.
fn circle_from(at: &str, edges: &BTreeMap<String, Vec<String>>) -> Option<Vec<String>> {
    let mut ways = vec![vec![at.to_string()]];
    let mut seen: Vec<String> = Vec::new();
    while let Some(way) = ways.pop() {
        for next in edges.get(way.last()?).into_iter().flatten() {
            let longer = [way.as_slice(), std::slice::from_ref(next)].concat();
            if next == at {
                return Some(longer);
            }
            if !seen.contains(next) {
                seen.push(next.clone());
                ways.push(longer);
            }
        }
    }
    None
}

#[test]
fn files_of_a_room_form_no_circle() {
    let rooms = rooms();
    assert!(rooms.len() > 30, "{rooms:?}");
    for room in &rooms {
        let mut edges: BTreeMap<String, Vec<String>> = BTreeMap::new();
        for (name, text) in rust_files(&[&format!("src/{room}")]) {
            let inside = name.strip_prefix(&format!("src/{room}/")).unwrap();
            let file = inside.split('/').next().unwrap().trim_end_matches(".rs").to_string();
            if file == "mod" {
                continue;
            }
            let mut imported = imported_files(room, &name, &text);
            imported.retain(|other| *other != file);
            edges.entry(file).or_default().extend(imported);
        }
        let circle = edges.keys().find_map(|file| circle_from(file, &edges));
        assert_eq!(circle, None, "files of {room} import each other in a circle");
    }
}

#[test]
fn the_reader_of_imports_sees_what_it_should() {
    let text =
        "use super::a::X;\nuse super::{b, c::Y};\nuse crate::train::d;\n#[cfg(test)]\nmod tests { use super::e::Z; }\n";
    assert_eq!(imported_files("train", "src/train/f.rs", text), ["a", "b", "c", "d"]);
    let text = "use super::super::a::X;\nuse super::b::Y;\n";
    assert_eq!(imported_files("train", "src/train/stores/f.rs", text), ["a", "stores"]);
    let text = "use super::a::X;\nuse crate::page::map::b::Y;\nuse crate::page::c::Z;\n";
    assert_eq!(imported_files("page/map", "src/page/map/f.rs", text), ["a", "b"]);
    let text =
        "use crate::train::{a::b, c::{d, e::F}, g};\nfn f() -> crate::train::h::I {}\nuse crate::{train, base::rng};";
    assert_eq!(imported_files("train", "src/train/f.rs", text), ["a", "c", "c", "g", "h"]);
    let layers = named_paths("src/a.rs", &without_comments("// crate::train\nuse crate::{optim::x as y, base};"));
    assert_eq!(layers.iter().map(|path| path.join("::")).collect::<Vec<_>>(), ["optim::x", "as", "y", "base"]);
    let edges = [("a", "b"), ("b", "c"), ("c", "b")].map(|(from, to)| (from.to_string(), vec![to.to_string()]));
    assert_eq!(circle_from("b", &edges.clone().into()).map(|way| way.len()), Some(3));
    assert_eq!(circle_from("a", &edges.into()), None);
}

/// Name of the type whose own methods an `impl` line holds. A trait's methods, and a macro's types, have none.
fn type_of_impl(line: &str) -> Option<String> {
    let header = line.strip_prefix("impl")?.replace("->", "");
    let mut depth = 0;
    let parameters = header.find(|c| {
        depth += i32::from(c == '<') - i32::from(c == '>');
        depth == 0
    })?;
    let path = header[parameters + 1..].trim_start().split([' ', '<']).next()?.rsplit("::").next()?;
    (!header.contains(" for ") && path.starts_with(char::is_alphabetic)).then(|| path.to_string())
}

/// Name of the type or trait that a line declares. Associated types have no name of their own.
fn declared_type(line: &str) -> Option<&str> {
    let code = line.trim_start();
    let code = match code.strip_prefix("pub") {
        Some(rest) if rest.starts_with('(') => rest.split_once(") ")?.1,
        Some(rest) => rest.trim_start(),
        None => code,
    };
    let kinds = ["struct ", "enum ", "trait ", "type "];
    let kinds = &kinds[..if line.starts_with(' ') { 3 } else { 4 }];
    let name = kinds.iter().find_map(|kind| code.strip_prefix(kind))?;
    name.split(|c: char| !c.is_alphanumeric() && c != '_').next().filter(|name| !name.is_empty())
}

/// For each top folder and name, the files that declare such a type; and the files with its own methods, `cfg` twins aside.
type Homes = BTreeMap<(String, String), [Vec<String>; 2]>;

fn homes_of_types() -> Homes {
    let mut homes = Homes::new();
    for (name, text) in rust_files(&["src"]) {
        let top = name.split('/').nth(1).unwrap().to_string();
        let mut before = String::new();
        for line in code_of(&text).lines() {
            let found = declared_type(line).map(|of| (of.to_string(), 0));
            let of_impl = || type_of_impl(line).filter(|_| !before.starts_with("#[cfg(")).map(|of| (of, 1));
            if let Some((of, which)) = found.or_else(of_impl) {
                let files = &mut homes.entry((top.clone(), of)).or_default()[which];
                if !files.contains(&name) {
                    files.push(name.clone());
                }
            }
            before = line.to_string();
        }
    }
    homes
}

#[test]
fn the_methods_of_a_type_stand_in_one_file() {
    let mut spread = Vec::new();
    for ((top, of), [declared, methods]) in homes_of_types() {
        // Files that each declare a private type of the same name hold several types.
        if methods.len() > 1 && methods.iter().any(|file| !declared.contains(file)) {
            spread.push((format!("{top} {of}"), methods));
        }
    }
    let unlisted: Vec<_> = spread.iter().filter(|(of, _)| !SPREAD_TYPES.contains(&of.as_str())).collect();
    assert!(unlisted.is_empty(), "bring the methods of these types into one file each: {unlisted:#?}");
    let stale: Vec<_> = SPREAD_TYPES.iter().filter(|of| !spread.iter().any(|(known, _)| known == **of)).collect();
    assert!(stale.is_empty(), "take these out of SPREAD_TYPES, they stand in one file now: {stale:?}");
    let lines = ["impl A {", "impl<'a, F: Fn(u8) -> B<'a>> crate::C<'a, F> {", "impl D for E {", "impl<'a> $F<'a> {"];
    assert_eq!(lines.map(type_of_impl), [Some("A"), Some("C"), None, None].map(|of| of.map(str::to_string)));
}

#[test]
fn few_types_share_a_name() {
    let mut owners: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for ((_, of), [declared, _]) in homes_of_types() {
        owners.entry(of).or_default().extend(declared);
    }
    owners.retain(|_, files| files.len() > 1);
    let (count, most) = (owners.len(), SHARED_TYPE_NAMES_MAX);
    assert!(count <= most, "{count} names have several types, of at most {most}; find a name of its own: {owners:#?}");
    let lines =
        ["pub(in crate::a) struct B<T> {", "type C = D;", "    type Err = E;", "    enum F {", "pub trait $View {"];
    assert_eq!(lines.map(declared_type), [Some("B"), Some("C"), None, Some("F"), None]);
}

#[test]
fn unsafe_stands_only_where_it_is_argued() {
    let mut wrong = Vec::new();
    for (name, text) in rust_files(&["src", "tools", "benches"]) {
        let lines: Vec<&str> = text.lines().collect();
        for (i, line) in lines.iter().enumerate() {
            let code = line.split("//").next().unwrap_or("");
            let is_block = code.contains("unsafe {") || code.contains("unsafe impl") || code.contains("unsafe fn");
            if is_block && !UNSAFE_FILES.contains(&name.as_str()) {
                wrong.push(format!("{name}:{}: unsafe outside the files for it", i + 1));
            } else if is_block && !lines[i.saturating_sub(3)..i].iter().any(|l| l.contains("SAFETY:")) {
                wrong.push(format!("{name}:{}: unsafe without its SAFETY argument", i + 1));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn files_say_what_they_are_and_leave_no_markers() {
    // `eprintln!` ends the program when its line cannot be written: `say!` and `tell!` do not.
    let markers = ["todo!(", "unimplemented!(", "dbg!(", "FIXME", "XXX", "(being written)", "eprintln!(", "eprint!("];
    let mut wrong = Vec::new();
    for (name, text) in rust_files(&["src", "tools", "benches"]) {
        if !text.starts_with("//!") {
            wrong.push(format!("{name}: the first line does not say what the file is responsible for"));
        }
        for marker in markers {
            if text.contains(marker) {
                wrong.push(format!("{name}: holds {marker}"));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Files that the comments of a text name.
fn named_files(text: &str) -> Vec<&str> {
    let is_path = |c: char| c.is_alphanumeric() || "_/.".contains(c);
    let comments = text.lines().filter_map(|line| Some(line.split_once("//")?.1));
    let words = comments.flat_map(|comment| comment.split(move |c| !is_path(c)));
    words.map(|word| word.trim_end_matches('.')).filter(|w| w.ends_with(".rs") || w.ends_with(".wgsl")).collect()
}

#[test]
fn files_that_comments_name_exist() {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let mut wrong = Vec::new();
    for (name, text) in rust_files(&["src", "tools", "benches"]) {
        let folders = Path::new(&name).ancestors().skip(1).map(Path::to_path_buf);
        let folders: Vec<PathBuf> = folders.chain(["src".into(), "shaders".into()]).collect();
        let exists = |file: &str| folders.iter().any(|folder| root.join(folder).join(file).is_file());
        // A file x stands for any.
        let missing = named_files(&text).into_iter().filter(|file| !exists(file) && !file.ends_with("/x.wgsl"));
        wrong.extend(missing.map(|file| format!("{name} names {file}")));
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    assert_eq!(named_files("let a; // see `b/c.rs`, d.wgsl.\nlet e = \"f.rs\";"), ["b/c.rs", "d.wgsl"]);
}

/// Cargo.toml switches the tests of some programs off, to build less. A test in one of these would never run.
#[test]
fn programs_whose_tests_are_off_have_none() {
    let manifest = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("Cargo.toml")).unwrap();
    let programs = manifest.split("[[bin]]").skip(1).filter(|section| section.contains("test = false"));
    let stems: Vec<&str> = programs.map(|section| section.split("path = \"").nth(1).unwrap()).collect();
    let stems: Vec<&str> = stems.iter().map(|rest| rest.split(".rs\"").next().unwrap()).collect();
    assert!(stems.contains(&"tools/train"), "{stems:?}");
    let is_off = |name: &str| {
        let of = |stem: &&str| name.strip_prefix(*stem).is_some_and(|rest| rest.starts_with(['.', '/']));
        stems.iter().any(of)
    };
    let files = rust_files(&["tools"]).into_iter();
    let wrong: Vec<String> =
        files.filter(|(name, text)| is_off(name) && text.contains("#[test]")).map(|(name, _)| name).collect();
    assert!(wrong.is_empty(), "remove `test = false` from the programs of these: {wrong:?}");
}

#[test]
fn files_stay_readable() {
    let files = rust_files(&["src", "tools"]).into_iter();
    let long: Vec<String> = files
        .map(|(name, text)| (name, text.lines().count()))
        .filter(|(_, lines)| *lines > FILE_LINES_MAX)
        .map(|(name, lines)| format!("{name}: {lines} lines"))
        .collect();
    assert!(long.is_empty(), "files over {FILE_LINES_MAX} lines; split them by idea:\n{}", long.join("\n"));
}

#[test]
fn readme_stays_short() {
    let readme = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("README.md")).unwrap();
    let words = readme.split_whitespace().count();
    assert!(words <= README_WORDS_MAX, "README.md has {words} words, of at most {README_WORDS_MAX}");
}

/// Functions are found by their closing brace at the indentation of their `fn`, which rustfmt guarantees.
#[test]
fn functions_stay_readable() {
    let mut wrong = Vec::new();
    for (name, text) in rust_files(&["src", "tools"]) {
        let lines: Vec<&str> = text.lines().collect();
        for (start, line) in lines.iter().enumerate() {
            let code = line.trim_start();
            let is_function = ["fn ", "pub fn ", "pub(crate) fn ", "pub(super) fn ", "pub(in crate::page) fn "]
                .iter()
                .any(|p| code.starts_with(p));
            // A function of a trait may have no body.
            if !is_function || line.ends_with(['}', ';']) {
                continue;
            }
            let closing = format!("{}}}", " ".repeat(line.len() - code.len()));
            let length = lines[start..].iter().position(|l| *l == closing).unwrap_or(0);
            if length > FUNCTION_LINES_MAX {
                wrong.push(format!("{name}:{}: {length} lines", start + 1));
            }
        }
    }
    assert!(wrong.is_empty(), "functions over {FUNCTION_LINES_MAX} lines:\n{}", wrong.join("\n"));
}
