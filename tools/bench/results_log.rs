//! A log of finished runs, one JSON line per run, which survives a crash.
//!
//! Invariants: 1. every line but the last is complete; opening the log for writing removes an incomplete last line; 2.
//! a line is durable before [`ResultsLog::append`] returns. The caller guarantees that one process writes at a time: a
//! sweep locks its output folder.

use super::record::RunRecord;
use gsscale::base::error::{InputError, InputResult};
use std::fs::{File, OpenOptions};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// Size limit of the log, bytes: about a hundred thousand runs.
const BYTES_MAX: u64 = 256 << 20;

/// A log that is open for writing, with the runs so far.
#[derive(Debug)]
pub struct ResultsLog {
    path: PathBuf,
    file: File,
    records: Vec<RunRecord>,
}

impl ResultsLog {
    /// Opens or creates the log and removes an incomplete last line.
    /// Errors: the log cannot be read or written, or a complete line does not hold a result.
    pub fn open(path: &Path) -> InputResult<ResultsLog> {
        let io = |e: std::io::Error| InputError::io(path, "opening the results", &e);
        let mut file = OpenOptions::new().read(true).append(true).create(true).open(path).map_err(io)?;
        let (records, complete_bytes) = read(path, &mut file)?;
        file.set_len(complete_bytes).map_err(io)?;
        file.seek(SeekFrom::End(0)).map_err(io)?;
        Ok(ResultsLog { path: path.to_path_buf(), file, records })
    }

    /// Reads the records of a log without changing it; none if the file does not exist.
    /// Errors: as [`ResultsLog::open`].
    pub fn peek(path: &Path) -> InputResult<Vec<RunRecord>> {
        match File::open(path) {
            Ok(mut file) => Ok(read(path, &mut file)?.0),
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(Vec::new()),
            Err(e) => Err(InputError::io(path, "opening the results", &e)),
        }
    }

    pub fn records(&self) -> &[RunRecord] {
        &self.records
    }

    /// Appends a run. Errors: the log cannot be written.
    pub fn append(&mut self, record: RunRecord) -> InputResult<()> {
        let io = |e: std::io::Error| InputError::io(&self.path, "writing the results", &e);
        let text = serde_json::to_string(&record).map_err(|e| io(e.into()))? + "\n";
        self.file.write_all(text.as_bytes()).and_then(|()| self.file.sync_data()).map_err(io)?;
        self.records.push(record);
        Ok(())
    }
}

/// The last successful run with this key.
pub fn successful_run<'a>(records: &'a [RunRecord], key: &str) -> Option<&'a RunRecord> {
    records.iter().rev().find(|r| r.key == key && r.problem.is_none())
}

/// The records of the complete lines, and the bytes of these lines.
fn read(path: &Path, file: &mut File) -> InputResult<(Vec<RunRecord>, u64)> {
    let io = |e: std::io::Error| InputError::io(path, "reading the results", &e);
    let mut bytes = Vec::new();
    file.take(BYTES_MAX + 1).read_to_end(&mut bytes).map_err(io)?;
    if bytes.len() as u64 > BYTES_MAX {
        let problem = format!("exceeds {} MiB, the size limit of results", BYTES_MAX >> 20);
        return Err(InputError::new(path, problem, "choose another --out"));
    }
    let whole = bytes.iter().rposition(|&b| b == b'\n').map_or(0, |at| at + 1);
    let lines = bytes[..whole].split(|&b| b == b'\n').enumerate().filter(|(_, line)| !line.is_empty());
    let mut records = Vec::new();
    for (number, line) in lines {
        let record = serde_json::from_slice(line).map_err(|e| {
            let problem = format!("line {} is not a result: {e}", number + 1);
            InputError::new(path, problem, "remove the line, or choose another --out")
        })?;
        records.push(record);
    }
    Ok((records, whole as u64))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(key: &str, problem: Option<&str>) -> RunRecord {
        RunRecord { key: key.into(), problem: problem.map(str::to_string), ..RunRecord::default() }
    }

    #[test]
    fn a_log_cut_at_any_byte_keeps_its_complete_lines_and_accepts_more() {
        let folder = tempfile::TempDir::new().unwrap();
        let path = folder.path().join("cut.jsonl");
        let mut log = ResultsLog::open(&path).unwrap();
        ["a", "b"].iter().for_each(|key| log.append(record(key, None)).unwrap());
        drop(log);
        let bytes = std::fs::read(&path).unwrap();
        let first = bytes.iter().position(|&b| b == b'\n').unwrap() + 1;
        for cut in 0..=bytes.len() {
            std::fs::write(&path, &bytes[..cut]).unwrap();
            let whole = usize::from(cut >= first) + usize::from(cut == bytes.len());
            assert_eq!(ResultsLog::peek(&path).unwrap().len(), whole);
            let mut log = ResultsLog::open(&path).unwrap();
            assert_eq!(log.records().len(), whole, "cut at {cut}");
            log.append(record("c", None)).unwrap();
            drop(log);
            let keys: Vec<String> = ResultsLog::peek(&path).unwrap().into_iter().map(|r| r.key).collect();
            assert_eq!(keys, [&["a", "b"][..whole], &["c"]].concat());
        }
    }

    #[test]
    fn failed_runs_are_not_successful_and_broken_lines_are_named() {
        let folder = tempfile::TempDir::new().unwrap();
        let path = folder.path().join("failed.jsonl");
        let mut log = ResultsLog::open(&path).unwrap();
        log.append(record("a", Some("no memory"))).unwrap();
        assert!(successful_run(log.records(), "a").is_none());
        log.append(record("a", None)).unwrap();
        assert!(successful_run(log.records(), "a").is_some() && successful_run(log.records(), "b").is_none());
        drop(log);
        std::fs::write(&path, "{\"key\":\"a\"}\nnonsense\n{}\n").unwrap();
        assert!(ResultsLog::open(&path).unwrap_err().to_string().contains("line 2"));
        assert!(ResultsLog::peek(&path.with_file_name("none")).unwrap().is_empty());
    }
}
