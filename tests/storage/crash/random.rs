//! Random lives: each seed runs several lives, with power failures, injected errors, kills, rollbacks and decay between
//! them.

use super::decay;
use super::disk::{Disk, Fault, FaultPlan, Rng, Survival};
use super::life::{CONFIG, End, end_of, open};
use super::oracle::{Acknowledged, Oracle};
use gsscale::page::map::opening::Opened;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

#[derive(Debug, Clone, Copy, Default)]
pub struct Counts {
    pub seeds: u64,
    pub crashes: u64,
    pub kills: u64,
    pub commits: u64,
    pub faults: u64,
    pub decays: u64,
    pub decays_noticed: u64,
}

const LIVES: u64 = 6;
const STEPS: u64 = 40;
const PROGRESS: Duration = Duration::from_secs(30);

impl Counts {
    fn add(&mut self, other: &Counts) {
        self.seeds += other.seeds;
        self.crashes += other.crashes;
        self.kills += other.kills;
        self.commits += other.commits;
        self.faults += other.faults;
        self.decays += other.decays;
        self.decays_noticed += other.decays_noticed;
    }
}

struct Progress {
    counts: Counts,
    said: Instant,
}

/// Runs seeds from `first` on, on every core, until `wanted` crashes have happened. `Err` is the first violation; `Ok`
/// means no lost commit and no wrong byte.
pub fn run_many(first: u64, wanted: u64) -> Result<Counts, String> {
    let (next, start) = (AtomicU64::new(first), Instant::now());
    let progress = Mutex::new(Progress { counts: Counts::default(), said: start });
    let work = || loop {
        let mut counts = Counts::default();
        let ended = run_seed(next.fetch_add(1, Ordering::Relaxed), &mut counts);
        let mut progress = progress.lock().unwrap_or_else(PoisonError::into_inner);
        ended.map_err(|what| format!("after {} crashes: {what}", progress.counts.crashes))?;
        progress.counts.add(&counts);
        let crashes = progress.counts.crashes;
        if crashes >= wanted {
            return Ok(());
        }
        if progress.said.elapsed() >= PROGRESS {
            progress.said = Instant::now();
            let seconds = start.elapsed().as_secs_f64();
            let left = seconds * (wanted - crashes) as f64 / crashes as f64 / 60.0;
            println!("{crashes} of {wanted} crashes in {seconds:.0} s, about {left:.0} min to go");
        }
    };
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let ended: Result<(), String> = std::thread::scope(|scope| {
        let workers: Vec<_> = (0..threads).map(|_| scope.spawn(work)).collect();
        workers.into_iter().try_for_each(|worker| worker.join().map_err(|_| "a seed panicked".to_string())?)
    });
    ended?;
    Ok(progress.into_inner().unwrap_or_else(PoisonError::into_inner).counts)
}

/// One seed. An error is a violation.
pub fn run_seed(seed: u64, counts: &mut Counts) -> Result<(), String> {
    let mut rng = Rng(seed);
    let disk = Disk::new(rng.next());
    let mut oracle = Oracle::default();
    let mut past = disk.fork();
    counts.seeds += 1;
    for life in 0..LIVES {
        prepare(&disk, &mut rng, life);
        let before = disk.faults_given();
        let ended = live(&disk, &mut oracle, &mut rng);
        counts.faults += disk.faults_given() - before;
        match ended.map_err(|end| end_of(&disk, end)) {
            Err(End::Violation(what)) => return Err(format!("seed {seed} life {life}: {what}")),
            Ok(()) | Err(End::Stopped) => {}
        }
        if rng.one_in(6) {
            disk.process_killed();
            counts.kills += 1;
        } else {
            disk.power_cycle(survival(&mut rng));
            counts.crashes += 1;
        }
        if rng.one_in(4) {
            let noticed = decay::spoil_and_open(&disk, &past, &oracle, &mut rng);
            counts.decays += 1;
            counts.decays_noticed += u64::from(noticed.map_err(|what| format!("seed {seed} life {life}: {what}"))?);
        }
        if rng.one_in(3) {
            past = disk.fork();
        }
        if rng.one_in(8) {
            roll_back(&disk, &mut oracle, &mut rng, counts)
                .map_err(|what| format!("seed {seed} life {life}: {what}"))?;
        }
    }
    counts.commits += oracle.commits;
    // A last opening without faults.
    disk.process_killed();
    match open(&disk, &mut oracle, rng.next()) {
        Err(End::Violation(what)) => Err(format!("seed {seed} at the end: {what}")),
        Err(End::Stopped) => Err(format!("seed {seed}: the store does not open on a healthy disk")),
        Ok(_) => Ok(()),
    }
}

fn survival(rng: &mut Rng) -> Survival {
    match rng.below(8) {
        0 => Survival::Nothing,
        1 => Survival::Everything,
        2 => Survival::First(rng.below(30) as usize),
        3 => Survival::Mask(rng.next()),
        n => Survival::Sectors(rng.next(), [16, 512, 512, 4096][n as usize - 4], n == 5),
    }
}

fn prepare(disk: &Disk, rng: &mut Rng, life: u64) {
    disk.forget_faults();
    if !rng.one_in(8) {
        let span = if life == 0 { 80 } else { 150 };
        disk.crash_at(disk.clock() + 1 + rng.below(span));
    }
    match rng.below(9) {
        0 => disk.fail_sync(Some(rng.below(16))),
        1 | 2 => {
            let fault = [Fault::Full, Fault::Io, Fault::TooManyFiles, Fault::Short, Fault::Interrupted, Fault::Full];
            let fault = fault[rng.below(6) as usize];
            let at_call = disk.calls() + 1 + rng.below(300);
            disk.set_fault(Some(FaultPlan { at_call, fault, calls: [1, 8, 40, u64::MAX][rng.below(4) as usize] }));
        }
        3 | 4 => disk.short_write(Some(rng.below(20))),
        _ => {}
    }
}

fn live(disk: &Disk, oracle: &mut Oracle, rng: &mut Rng) -> Result<(), End> {
    let mut life = open(disk, oracle, rng.next())?;
    if rng.one_in(4) {
        life.commits.fill_reserve()?;
    }
    for _ in 0..rng.below(STEPS) + 4 {
        life.step(disk, rng)?;
        // Space returns at some time.
        if rng.one_in(16) {
            disk.end_shortage();
        }
    }
    Ok(())
}

/// A tool rolls the store back; the power may fail during the rollback.
fn roll_back(disk: &Disk, oracle: &mut Oracle, rng: &mut Rng, counts: &mut Counts) -> Result<(), String> {
    disk.forget_faults();
    let opened = match Opened::open(Box::new(disk.clone()), CONFIG) {
        Ok(opened) => opened,
        Err(_) if !oracle.is_created => return Ok(()),
        Err(error) => return Err(format!("before a rollback: {error}")),
    };
    oracle.judge(&opened)?;
    let kept: Vec<u64> = opened.commits.generations().kept().collect();
    let Some(&to) = kept.get(rng.below(kept.len() as u64) as usize) else { return Ok(()) };
    let change = |after: &mut Acknowledged| {
        after.latest = to;
        after.pins.retain(|_, generation| *generation <= to);
    };
    oracle.begin(change, None);
    let mut after = oracle.acknowledged.clone();
    change(&mut after);
    disk.crash_at(disk.clock() + 1 + rng.below(20));
    if opened.commits.rollback(to).is_ok() {
        oracle.acknowledge(&after, &[])?;
    }
    disk.power_cycle(survival(rng));
    counts.crashes += 1;
    Ok(())
}
