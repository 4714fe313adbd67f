//! Facts about this machine and process, for reports and budgets. No training result depends on them. Linux tells them in /proc; elsewhere
//! they come from [`crate::base::without_proc`].

use crate::base::without_proc;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;

/// CPU seconds, user and system, of all threads of this process so far; `None` if the system does not report them.
///
/// From /proc/self/stat, whose ticks are hundredths of a second on every Linux (USER_HZ).
pub fn process_cpu_seconds() -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok();
    let linux = stat.and_then(|stat| cpu_seconds_of(&stat)).map(|[user, system]| user + system);
    linux.or_else(without_proc::process_cpu_seconds)
}

/// Fields 14 and 15 are the ticks. The second field is the program's name in parentheses, which may contain anything,
/// so fields are counted from its end.
fn cpu_seconds_of(stat: &str) -> Option<[f64; 2]> {
    let after_name = &stat[stat.rfind(')')? + 1..];
    let mut fields = after_name.split_whitespace().skip(11);
    let mut ticks = || fields.next()?.parse::<u64>().ok();
    Some([ticks()? as f64 / 100.0, ticks()? as f64 / 100.0])
}

/// The name of this machine in its network.
pub fn host_name() -> String {
    #[cfg(unix)]
    return rustix::system::uname().nodename().to_string_lossy().into_owned();
    #[cfg(not(unix))]
    std::env::var("COMPUTERNAME").unwrap_or_default()
}

/// The name of this machine with a part of the identity that its kernel draws at each start, such as `node7-1c9f02ab`: machines that share a
/// name, as clones and containers may, differ in it. Off Linux the name alone.
pub fn system_name() -> String {
    let boot = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
    match boot.split('-').next().unwrap_or("").trim() {
        "" => host_name(),
        boot => format!("{}-{boot}", host_name()),
    }
}

/// The processor's name as the system gives it, else its architecture.
pub fn cpu_model() -> String {
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let line = text.lines().find(|l| l.starts_with("model name"));
    let name = line.and_then(|l| l.split_once(':')).map(|(_, name)| name.trim());
    name.unwrap_or(std::env::consts::ARCH).to_string()
}

/// Memory that this process can still allocate, bytes: the smaller of the machine's available memory and the rest of
/// its control groups' limits. `None` if the system does not report it.
pub fn memory_available() -> Option<u64> {
    let linux = std::fs::read_to_string("/proc/meminfo").ok().and_then(|text| meminfo_available(&text));
    let machine = linux.or_else(without_proc::memory_available)?;
    let groups = std::fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
    let left = group_folders(&groups).iter().filter_map(|(folder, files)| left_in_group(folder, files)).min();
    Some(left.map_or(machine, |left| left.min(machine)))
}

fn meminfo_available(text: &str) -> Option<u64> {
    let line = text.lines().find_map(|l| l.strip_prefix("MemAvailable:"))?;
    let kib: u64 = line.trim().trim_end_matches("kB").trim().parse().ok()?;
    Some(kib * 1024)
}

/// File names of a control group: limit, use, and the reclaimable page cache within the use.
struct GroupFiles {
    limit: &'static str,
    used: &'static str,
    cache: &'static str,
}

const GROUP_V1: GroupFiles =
    GroupFiles { limit: "memory.limit_in_bytes", used: "memory.usage_in_bytes", cache: "total_inactive_file" };
const GROUP_V2: GroupFiles = GroupFiles { limit: "memory.max", used: "memory.current", cache: "inactive_file" };

/// Folders of the memory groups that the lines of /proc/self/cgroup name, each with its ancestors: any of them may have
/// a limit. A container may see its own group as the root, so missing folders are tried as well.
fn group_folders(groups: &str) -> Vec<(PathBuf, &'static GroupFiles)> {
    let mut folders = Vec::new();
    for line in groups.lines() {
        let mut fields = line.splitn(3, ':').skip(1);
        let (Some(controllers), Some(path)) = (fields.next(), fields.next()) else { continue };
        let (root, files) = match controllers {
            "" => ("/sys/fs/cgroup", &GROUP_V2),
            list if list.split(',').any(|c| c == "memory") => ("/sys/fs/cgroup/memory", &GROUP_V1),
            _ => continue,
        };
        let inner = Path::new(path.trim_start_matches('/'));
        folders.extend(inner.ancestors().map(|part| (Path::new(root).join(part), files)));
    }
    folders
}

fn left_in_group(folder: &Path, files: &GroupFiles) -> Option<u64> {
    let number = |name: &str| std::fs::read_to_string(folder.join(name)).ok()?.trim().parse::<u64>().ok();
    // No limit is `max` in v2, and a number near 2^63 in v1, which needs no special case.
    let (limit, used) = (number(files.limit)?, number(files.used)?);
    let stat = std::fs::read_to_string(folder.join("memory.stat")).unwrap_or_default();
    let cache = stat.lines().find_map(|l| l.strip_prefix(files.cache)?.trim().parse::<u64>().ok()).unwrap_or(0);
    Some(limit.saturating_sub(used.saturating_sub(cache)))
}

/// Peak resident size of this process, bytes; `None` if the system does not report it. Off Linux the largest size that a call of this
/// function found.
pub fn host_bytes_peak() -> Option<u64> {
    status_field("VmHWM:").or_else(|| without_proc::host_bytes_now().map(|now| now.max(SEEN.fetch_max(now, Relaxed))))
}

/// The largest answer of [`host_bytes_peak`] off Linux.
static SEEN: AtomicU64 = AtomicU64::new(0);

/// Makes [`host_bytes_peak`] count from now on, for a process that trains several times. Where the system cannot do that, the peak stays
/// that of the whole process.
pub fn reset_host_bytes_peak() {
    // Linux; a failure leaves the larger peak.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
    SEEN.store(0, Relaxed);
}

/// Current resident size of this process, bytes; `None` if the system does not report it.
pub fn host_bytes_now() -> Option<u64> {
    status_field("VmRSS:").or_else(without_proc::host_bytes_now)
}

/// A size in /proc/self/status, bytes.
pub fn status_field(name: &str) -> Option<u64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    field(&text, name)
}

fn field(text: &str, name: &str) -> Option<u64> {
    let line = text.lines().find(|l| l.starts_with(name))?;
    let kib: u64 = line[name.len()..].trim().trim_end_matches("kB").trim().parse().ok()?;
    Some(kib * 1024)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    #[test]
    #[cfg(target_os = "linux")]
    fn groups_are_found_with_their_ancestors_in_both_versions() {
        let folders = |text: &str| -> Vec<String> {
            group_folders(text).iter().map(|(folder, files)| format!("{} {}", folder.display(), files.limit)).collect()
        };
        assert_eq!(
            folders("9:name=systemd:/\n4:cpu,memory:/a/b\n0::/\n"),
            [
                "/sys/fs/cgroup/memory/a/b memory.limit_in_bytes",
                "/sys/fs/cgroup/memory/a memory.limit_in_bytes",
                "/sys/fs/cgroup/memory/ memory.limit_in_bytes",
                "/sys/fs/cgroup/ memory.max",
            ]
        );
        assert_eq!(folders("0::/x:y\nnonsense\n"), ["/sys/fs/cgroup/x:y memory.max", "/sys/fs/cgroup/ memory.max"]);
    }

    #[test]
    fn reclaimable_cache_counts_as_left_within_a_limit() -> std::io::Result<()> {
        let folder = std::env::temp_dir().join(format!("gsscale-group-{}", std::process::id()));
        std::fs::create_dir_all(&folder)?;
        let write = |name: &str, text: &str| std::fs::write(folder.join(name), text);
        write("memory.max", "1000\n")?;
        write("memory.current", "700\n")?;
        write("memory.stat", "anon 100\ninactive_file 300\nactive_file 50\n")?;
        let left = left_in_group(&folder, &GROUP_V2);
        write("memory.max", "max\n")?;
        let unlimited = left_in_group(&folder, &GROUP_V2);
        let missing = left_in_group(&folder, &GROUP_V1);
        std::fs::remove_dir_all(&folder)?;
        assert_eq!((left, unlimited, missing), (Some(600), None, None));
        assert_eq!(meminfo_available("MemTotal: 5 kB\nMemAvailable:      3 kB\n"), Some(3072));
        Ok(())
    }

    #[test]
    fn a_name_with_spaces_and_parentheses_does_not_shift_the_fields() {
        let stat = "12 (a) b (c) S 1 2 3 4 5 6 7 8 9 10 250 50 0 0 20 0 3";
        assert_eq!(cpu_seconds_of(stat), Some([2.5, 0.5]));
        assert_eq!(cpu_seconds_of("12 (a) S 1"), None);
        assert_eq!(cpu_seconds_of(""), None);
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn a_reset_peak_forgets_memory_that_was_given_back() {
        const HELD: usize = 256 << 20;
        drop(std::hint::black_box(vec![1u8; HELD]));
        let before = host_bytes_peak().unwrap();
        assert!(before >= HELD as u64, "{before}");
        reset_host_bytes_peak();
        let after = host_bytes_peak().unwrap();
        assert!(after + HELD as u64 / 2 < before, "{before} bytes, then {after}");
    }
}
