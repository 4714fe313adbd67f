//! House rules that the compiler does not hold: which layer may name which, how long functions and files are, where `unsafe`
//! may stand, and that no marker of unfinished work is left.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// For each layer, the layers that it may name (itself always).
const LAYERS: &[(&str, &[&str])] = &[
    ("base", &[]),
    ("scene", &["base"]),
    ("dataset", &["base", "scene"]),
    ("schedule", &["base", "scene"]),
    ("page", &["base"]),
    ("paging", &["base", "scene", "page", "schedule"]),
    ("checkpoint", &["base", "scene", "page", "paging", "densify", "photos"]),
    ("gpu", &["base"]),
    ("kernels", &["base", "scene"]),
    ("optim", &["base", "scene"]),
    ("photos", &["base", "scene", "dataset", "page", "kernels"]),
    ("densify", &["base", "scene", "optim"]),
    ("render", &["base", "scene", "gpu", "kernels"]),
    ("exchange", &["base", "scene"]),
    ("report", &["base", "photos"]),
    (
        "config",
        &[
            "base",
            "scene",
            "dataset",
            "schedule",
            "kernels",
            "optim",
            "densify",
            "photos",
            "gpu",
            "render",
            "exchange",
            "page",
            "paging",
            "checkpoint",
        ],
    ),
    (
        "train",
        &[
            "base",
            "scene",
            "dataset",
            "schedule",
            "page",
            "paging",
            "checkpoint",
            "kernels",
            "optim",
            "densify",
            "photos",
            "gpu",
            "render",
            "exchange",
            "report",
            "config",
        ],
    ),
];

/// Files that may hold `unsafe`, each block with its argument.
const UNSAFE_FILES: &[&str] = &[
    "src/base/allocator.rs",
    "src/base/environment.rs",
    "src/base/simd.rs",
    "src/page/engine/mmap.rs",
    "src/page/engine/registered.rs",
    "src/page/engine/uring.rs",
    "src/train/inputs/signals.rs",
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

/// Layers that a source text names through `crate::<layer>` (also inside `crate::{a, b}`), tests included.
fn named_layers(text: &str) -> Vec<String> {
    let code: String = text.lines().filter(|l| !l.trim_start().starts_with("//")).collect::<Vec<_>>().join("\n");
    let mut names = Vec::new();
    for (at, _) in code.match_indices("crate::") {
        let rest = &code[at + "crate::".len()..];
        if let Some(list) = rest.strip_prefix('{') {
            let list = &list[..list.find('}').unwrap_or(list.len())];
            names.extend(list.split(',').map(|n| n.trim().split("::").next().unwrap_or("").to_string()));
        } else {
            names.push(rest.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect());
        }
    }
    names.retain(|n| LAYERS.iter().any(|(layer, _)| layer == n));
    names
}

#[test]
fn dependencies_point_one_way() {
    let allowed: BTreeMap<&str, &[&str]> = LAYERS.iter().copied().collect();
    let mut wrong = Vec::new();
    for (name, text) in rust_files(&["src"]) {
        let Some(layer) = Path::new(&name).components().nth(1) else { continue };
        let layer = layer.as_os_str().to_string_lossy().into_owned();
        if layer == "lib.rs" {
            continue;
        }
        let allowed = allowed.get(layer.as_str()).unwrap_or_else(|| panic!("{name}: folder {layer} has no layer"));
        for used in named_layers(&text) {
            if used != layer && !allowed.contains(&used.as_str()) {
                wrong.push(format!("{name} names {used}"));
            }
        }
    }
    assert!(wrong.is_empty(), "these point the wrong way:\n{}", wrong.join("\n"));
}

#[test]
fn the_layer_reader_sees_what_it_should() {
    let text = "use crate::scene::camera::Camera;\n// crate::train in a comment\nuse crate::{optim, base::rng};\n";
    assert_eq!(named_layers(text), ["scene", "optim", "base"]);
}

/// Rooms, and folders of rooms.
fn rooms() -> Vec<String> {
    let names = rust_files(&["src"]).into_iter().map(|(name, _)| name);
    let folder = |name: String| Some(Path::new(name.strip_prefix("src/")?).parent()?.to_str()?.to_string());
    let mut rooms: Vec<String> = names.filter_map(folder).filter(|room| !room.is_empty()).collect();
    rooms.dedup();
    rooms
}

/// Files of a room (a folder in it counts as one) that a file of the room imports, tests left out.
fn imported_files(room: &str, name: &str, text: &str) -> Vec<String> {
    let depth = Path::new(name).components().count() - if name.ends_with("/mod.rs") { 1 } else { 0 };
    // From src/ROOM/file.rs the room is one step up, from src/ROOM/folder/file.rs two.
    let above = 1 + Path::new(room).components().count();
    let prefixes = ["super::".repeat(depth.saturating_sub(above)), format!("crate::{}::", room.replace('/', "::"))];
    let code = text.split("#[cfg(test)]").next().unwrap_or("");
    let mut found = Vec::new();
    for statement in code.split("use ").skip(1).map(|rest| rest.split(';').next().unwrap_or("")) {
        let Some(rest) = prefixes.iter().filter(|p| !p.is_empty()).find_map(|p| statement.strip_prefix(p.as_str()))
        else {
            continue;
        };
        let names = rest.strip_prefix('{').map_or(vec![rest], |list| list.trim_end_matches('}').split(',').collect());
        let first = |path: &str| path.trim().split("::").next().unwrap_or("").to_string();
        found.extend(names.into_iter().map(first).filter(|n| n != "super" && !n.is_empty()));
    }
    found
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
    assert_eq!(imported_files("train", "src/train/stores/f.rs", text), ["a"]);
    let text = "use super::a::X;\nuse crate::page::map::b::Y;\nuse crate::page::c::Z;\n";
    assert_eq!(imported_files("page/map", "src/page/map/f.rs", text), ["a", "b"]);
    let edges = [("a", "b"), ("b", "c"), ("c", "b")].map(|(from, to)| (from.to_string(), vec![to.to_string()]));
    assert_eq!(circle_from("b", &edges.clone().into()).map(|way| way.len()), Some(3));
    assert_eq!(circle_from("a", &edges.into()), None);
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
