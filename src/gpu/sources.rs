//! Shader sources: the table of those built into the program, and a small preprocessor.
//! `tests/numerics/shaders.rs` fails if a shader file is missing from the table.
//!
//! The preprocessor knows these directives, at the start of a line:
//!
//! - `#import "shared/x.wgsl"`: inserts the file, each file once;
//! - `#ifdef NAME`, `#ifndef NAME`, `#else`, `#endif`;
//! - `#param NAME 0 1 2 3`: replaces `NAME` by a value; the first one unless a define selects another, and only listed
//!   values are accepted, so that every variant can be tested;
//! - `#repeat NAME 0u 1u` ... `#end`: repeats the lines between, once for each value of `NAME`.
//!
//! Invariant: a define that a shader does not know is an error.

use std::collections::{BTreeMap, BTreeSet};

use super::error::{GpuError, GpuResult};

#[derive(Debug, Clone, Copy)]
pub struct Source {
    /// Path under `shaders/`, with forward slashes.
    pub name: &'static str,
    /// WGSL with preprocessor directives.
    pub text: &'static str,
}

/// Names and values; a switch for `#ifdef` has an empty value.
pub type Defines<'a> = &'a [(&'a str, &'a str)];

macro_rules! sources {
    ($($name:literal),* $(,)?) => {
        /// Every file under `shaders/`, by its path there.
        pub const SOURCES: &[Source] = &[
            $(Source { name: $name, text: include_str!(concat!("../../shaders/", $name)) }),*
        ];
    };
}

sources![
    "gate.wgsl",
    "gather.wgsl",
    "image_loss.wgsl",
    "isect_emit.wgsl",
    "isect_offsets.wgsl",
    "project_bwd.wgsl",
    "project_fwd.wgsl",
    "radix_sort.wgsl",
    "rasterize_bwd.wgsl",
    "rasterize_fwd.wgsl",
    "scan.wgsl",
    "sh_bwd.wgsl",
    "sh_fwd.wgsl",
    "submission_count.wgsl",
    "tile_range.wgsl",
    "update.wgsl",
    "shared/camera.wgsl",
    "shared/constants.wgsl",
    "shared/covariance.wgsl",
    "shared/deferred.wgsl",
    "shared/dispatch.wgsl",
    "shared/footprint.wgsl",
    "shared/math.wgsl",
    "shared/page.wgsl",
    "shared/quotient.wgsl",
    "shared/raster.wgsl",
    "shared/sh.wgsl",
    "shared/splat.wgsl",
    "shared/subgroups.wgsl",
    "shared/workgroup_scan.wgsl",
];

/// A source with its imports inserted.
fn stitch(source: &Source, seen: &mut BTreeSet<&'static str>, out: &mut Vec<String>) -> GpuResult<()> {
    for line in source.text.lines() {
        let Some(rest) = line.trim_start().strip_prefix("#import") else {
            out.push(line.to_string());
            continue;
        };
        let name = rest.trim().trim_matches('"');
        let import = SOURCES
            .iter()
            .find(|s| s.name == name)
            .ok_or_else(|| GpuError::shader(source.name, format!("imports {name:?}, which is not in the table")))?;
        if import.name != source.name && seen.insert(import.name) {
            stitch(import, seen, out)?;
        }
    }
    Ok(())
}

fn stitched(source: &Source) -> GpuResult<Vec<String>> {
    let mut lines = Vec::new();
    stitch(source, &mut BTreeSet::new(), &mut lines)?;
    Ok(lines)
}

/// The stitched lines with repetitions expanded.
fn repeated(source: &Source) -> GpuResult<Vec<String>> {
    let mut out = Vec::new();
    let mut open: Option<(String, Vec<String>, Vec<String>)> = None;
    for line in stitched(source)? {
        match (directive(&line).as_deref(), &mut open) {
            (Some(["repeat", name, values @ ..]), None) => {
                open = Some((name.to_string(), values.iter().map(|v| v.to_string()).collect(), Vec::new()));
            }
            (Some(["end"]), Some(_)) => {
                let Some((name, values, lines)) = open.take() else { continue };
                for value in values {
                    let as_value = BTreeMap::from([(name.clone(), value)]);
                    out.extend(lines.iter().map(|line| replaced(line, &as_value)));
                }
            }
            (Some(["repeat" | "end", ..]), _) => {
                return Err(GpuError::shader(source.name, format!("this directive is out of place: {line}")));
            }
            (_, Some((_, _, lines))) => lines.push(line),
            (_, None) => out.push(line),
        }
    }
    match open {
        Some(_) => Err(GpuError::shader(source.name, "a #repeat has no #end")),
        None => Ok(out),
    }
}

/// The words of a preprocessor line, without the `#`.
fn directive(line: &str) -> Option<Vec<&str>> {
    line.trim_start().strip_prefix('#').map(|rest| rest.split_whitespace().collect())
}

/// The defines that a shader knows.
pub(super) fn knows(source: &Source) -> GpuResult<BTreeSet<String>> {
    Ok(switches(source)?.into_iter().chain(params(source)?.into_keys()).collect())
}

/// Names of the `#ifdef` and `#ifndef` lines of a shader and its imports.
fn switches(source: &Source) -> GpuResult<BTreeSet<String>> {
    let lines = stitched(source)?;
    let words = lines.iter().filter_map(|l| directive(l));
    Ok(words.filter(|w| w.len() > 1 && (w[0] == "ifdef" || w[0] == "ifndef")).map(|w| w[1].to_string()).collect())
}

/// Names and values of the `#param` lines of a shader and its imports.
fn params(source: &Source) -> GpuResult<BTreeMap<String, Vec<String>>> {
    let mut found = BTreeMap::new();
    for line in stitched(source)? {
        let Some(words) = directive(&line).filter(|w| w.first() == Some(&"param")) else { continue };
        if words.len() < 3 {
            return Err(GpuError::shader(source.name, format!("a parameter needs a name and values: {line}")));
        }
        found.insert(words[1].to_string(), words[2..].iter().map(|v| v.to_string()).collect());
    }
    Ok(found)
}

/// All combinations of switches and parameter values of a shader.
/// Errors: an import is missing or a directive is malformed.
pub fn variants(source: &Source) -> GpuResult<Vec<Vec<(String, String)>>> {
    let mut all = vec![Vec::new()];
    for switch in &switches(source)? {
        let with: Vec<_> =
            all.iter().map(|v| [v.as_slice(), &[(switch.clone(), String::new())][..]].concat()).collect();
        all.extend(with);
    }
    for (name, values) in &params(source)? {
        let with = |v: &Vec<_>, value: &String| [v.as_slice(), &[(name.clone(), value.clone())][..]].concat();
        all = all.iter().flat_map(|v| values.iter().map(move |value| with(v, value))).collect();
    }
    Ok(all)
}

/// The WGSL text of a variant.
/// Errors: a define is unknown, a value is not in its list, an import is missing, or a condition is not closed.
pub fn preprocess(source: &Source, defines: Defines<'_>) -> GpuResult<String> {
    let switches = switches(source)?;
    let lists = params(source)?;
    let mut values: BTreeMap<_, _> = lists.iter().map(|(name, list)| (name.clone(), list[0].clone())).collect();
    for (name, value) in defines {
        match lists.get(*name) {
            Some(list) if list.iter().any(|v| v == value) => {
                values.insert(name.to_string(), value.to_string());
            }
            Some(list) => {
                let problem = format!("{name} = {value:?} is none of {}", list.join(", "));
                return Err(GpuError::shader(source.name, problem));
            }
            None if switches.contains(*name) => {}
            None => return Err(GpuError::shader(source.name, format!("does not know the define {name}"))),
        }
    }
    let is_defined = |name: &str| defines.iter().any(|(n, _)| *n == name) || values.contains_key(name);
    let mut out = String::new();
    let mut conditions: Vec<bool> = Vec::new();
    for line in repeated(source)? {
        let wrong = || GpuError::shader(source.name, format!("this directive is out of place: {line}"));
        match directive(&line).as_deref() {
            Some(["ifdef", name]) => conditions.push(is_defined(name)),
            Some(["ifndef", name]) => conditions.push(!is_defined(name)),
            Some(["else"]) => {
                let last = conditions.last_mut().ok_or_else(wrong)?;
                *last = !*last;
            }
            Some(["endif"]) => {
                conditions.pop().ok_or_else(wrong)?;
            }
            Some(["param", ..]) => {}
            Some(_) => return Err(wrong()),
            None if conditions.iter().all(|c| *c) => {
                out.push_str(&replaced(&line, &values));
                out.push('\n');
            }
            None => {}
        }
    }
    if !conditions.is_empty() {
        return Err(GpuError::shader(source.name, "an #ifdef has no #endif"));
    }
    Ok(out)
}

/// A line with parameter names, as whole words, replaced by their values.
fn replaced(line: &str, values: &BTreeMap<String, String>) -> String {
    if values.is_empty() {
        return line.to_string();
    }
    let mut out = String::with_capacity(line.len());
    let mut rest = line;
    while !rest.is_empty() {
        let is_word = |c: char| c.is_alphanumeric() || c == '_';
        let first_is_word = rest.starts_with(is_word);
        let end = rest.find(|c| is_word(c) != first_is_word).unwrap_or(rest.len());
        let (piece, tail) = rest.split_at(end);
        out.push_str(values.get(piece).map_or(piece, String::as_str));
        rest = tail;
    }
    out
}
