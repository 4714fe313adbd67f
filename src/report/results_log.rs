//! A file of finished runs, one JSON line each, that grows run by run and survives being cut off.
//!
//! Invariants: 1. a line is whole or it is the last one: what a crash left of a last line is cut away when the file is
//! opened to be written; 2. a line is on the drive before [`ResultsLog::append`] returns; 3. one process writes at a
//! time.

use super::record::RunRecord;
use crate::base::error::{InputError, InputResult};
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// Largest file that is read, bytes: some hundred thousand runs.
const BYTES_MAX: u64 = 256 << 20;

/// The runs so far, open for more.
#[derive(Debug)]
pub struct ResultsLog {
    path: PathBuf,
    file: File,
    records: Vec<RunRecord>,
}

impl ResultsLog {
    /// Opens or creates the file, cuts off a torn last line, and locks it.
    ///
    /// # Errors
    /// Another process writes to it, it cannot be read or written, or a line before the last is no result.
    pub fn open(path: &Path) -> InputResult<ResultsLog> {
        let io = |e: std::io::Error| InputError::io(path, "opening the results", &e);
        let mut file = OpenOptions::new().read(true).append(true).create(true).open(path).map_err(io)?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let remedy = "wait for the other one to end, or choose another --out";
                return Err(InputError::new(path, "another process is writing to it", remedy));
            }
            // Where a file system knows no locks there is one writer all the same.
            Err(TryLockError::Error(_)) => {}
        }
        let (records, whole) = read(path, &mut file)?;
        file.set_len(whole).map_err(io)?;
        file.seek(SeekFrom::End(0)).map_err(io)?;
        Ok(ResultsLog { path: path.to_path_buf(), file, records })
    }

    /// The records of a file, read without locking or changing it; none where there is no file.
    ///
    /// # Errors
    /// As [`ResultsLog::open`].
    pub fn peek(path: &Path) -> InputResult<Vec<RunRecord>> {
        match File::open(path) {
            Ok(mut file) => Ok(read(path, &mut file)?.0),
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(Vec::new()),
            Err(e) => Err(InputError::io(path, "opening the results", &e)),
        }
    }

    /// The runs so far, in order.
    pub fn records(&self) -> &[RunRecord] {
        &self.records
    }

    /// The run with this key, if it was done. A run that failed counts as not done.
    pub fn done(&self, key: &str) -> Option<&RunRecord> {
        self.records.iter().rev().find(|r| r.key == key && r.problem.is_none())
    }

    /// Adds a run.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn append(&mut self, record: RunRecord) -> InputResult<()> {
        let io = |e: std::io::Error| InputError::io(&self.path, "writing the results", &e);
        let text = serde_json::to_string(&record).map_err(|e| io(e.into()))? + "\n";
        self.file.write_all(text.as_bytes()).and_then(|()| self.file.sync_data()).map_err(io)?;
        self.records.push(record);
        Ok(())
    }
}

/// The records of the whole lines, and how many bytes those take.
fn read(path: &Path, file: &mut File) -> InputResult<(Vec<RunRecord>, u64)> {
    let io = |e: std::io::Error| InputError::io(path, "reading the results", &e);
    let mut bytes = Vec::new();
    file.take(BYTES_MAX + 1).read_to_end(&mut bytes).map_err(io)?;
    if bytes.len() as u64 > BYTES_MAX {
        let problem = format!("is larger than {} MiB, which no sweep writes", BYTES_MAX >> 20);
        return Err(InputError::new(path, problem, "choose another --out"));
    }
    let whole = bytes.iter().rposition(|&b| b == b'\n').map_or(0, |at| at + 1);
    let lines = bytes[..whole].split(|&b| b == b'\n').enumerate().filter(|(_, line)| !line.is_empty());
    let mut records = Vec::new();
    for (number, line) in lines {
        let record = serde_json::from_slice(line).map_err(|e| {
            let problem = format!("line {} is no result: {e}", number + 1);
            InputError::new(path, problem, "remove the line, or choose another --out")
        })?;
        records.push(record);
    }
    Ok((records, whole as u64))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    fn record(key: &str, problem: Option<&str>) -> RunRecord {
        RunRecord { key: key.into(), problem: problem.map(str::to_string), ..RunRecord::default() }
    }

    #[test]
    fn a_file_cut_at_any_byte_keeps_its_whole_lines_and_takes_more() {
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
    fn failed_runs_are_not_done_and_broken_lines_are_named() {
        let folder = tempfile::TempDir::new().unwrap();
        let path = folder.path().join("failed.jsonl");
        let mut log = ResultsLog::open(&path).unwrap();
        log.append(record("a", Some("no memory"))).unwrap();
        assert!(log.done("a").is_none());
        log.append(record("a", None)).unwrap();
        assert!(log.done("a").is_some() && log.done("b").is_none());
        assert!(ResultsLog::open(&path).unwrap_err().to_string().contains("another process"));
        drop(log);
        std::fs::write(&path, "{\"key\":\"a\"}\nnonsense\n{}\n").unwrap();
        assert!(ResultsLog::open(&path).unwrap_err().to_string().contains("line 2"));
        assert!(ResultsLog::peek(&path.with_file_name("none")).unwrap().is_empty());
    }
}
