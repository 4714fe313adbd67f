//! A small fixed workload under every possible failure: a power failure at every change, with all ways in which
//! unsynced changes survive, and an error in every call.

use super::disk::{Disk, Fault, FaultPlan, Survival};
use super::life::{End, Life, end_of, open};
use super::oracle::Oracle;
use gsscale::base::ids::PageId;

/// With up to this many unsynced changes, all subsets are tried.
const SUBSETS_MAX: usize = 8;

/// Three pages, a split, spills, a pin and its end; two lives.
fn run(disk: &Disk, oracle: &mut Oracle) -> Result<(), End> {
    {
        let mut life = open(disk, oracle, 1)?;
        (0..3).for_each(|page| life.edit(PageId::initial(page)));
        life.commit(None)?;
        first(&mut life, 0)?;
        life.split(PageId::initial(1));
        life.commit(Some("a"))?;
    }
    let mut life = open(disk, oracle, 2)?;
    first(&mut life, 1)?;
    first(&mut life, 1)?;
    life.commit(None)?;
    first(&mut life, 2)?;
    life.commit(None)?;
    life.pin(&[], &["a".to_string()])?;
    beside(&mut life)?;
    first(&mut life, 0)?;
    life.commit(None)
}

/// A commit beside changes: one page gets a newer version before the cut's version is written, another afterwards.
fn beside(life: &mut Life<'_>) -> Result<(), End> {
    let ids = life.ids();
    let [a, b, ..] = ids[..] else { return Ok(()) };
    life.edit(a);
    life.edit(b);
    life.freeze();
    life.write(b)?;
    life.edit(a);
    life.edit(b);
    life.write(a)?;
    life.commit_frozen(None)?;
    life.write(b)
}

/// Changes and spills a page.
fn first(life: &mut Life<'_>, index: usize) -> Result<(), End> {
    let Some(page) = life.ids().get(index).copied() else { return Ok(()) };
    life.edit(page);
    life.write(page)
}

/// Runs the workload, to its end or to a failure.
fn checked(disk: &Disk, oracle: &mut Oracle) -> Result<(), String> {
    match run(disk, oracle).map_err(|end| end_of(disk, end)) {
        Err(End::Violation(what)) => Err(what),
        Err(End::Stopped) | Ok(()) => Ok(()),
    }
}

/// Opens the remaining store and compares it; the store must then accept work.
fn reopen(disk: &Disk, oracle: &Oracle) -> Result<(), String> {
    disk.forget_faults();
    let mut oracle = oracle.clone();
    let again = open(disk, &mut oracle, 3).and_then(|mut life| {
        life.edit(PageId::initial(9));
        life.commit(None)
    });
    match again {
        Err(End::Violation(what)) => Err(what),
        Err(End::Stopped) => Err("the store does not open on a healthy disk".to_string()),
        Ok(()) => Ok(()),
    }
}

/// All ways in which unsynced changes survive: whole changes in (nearly) all subsets, and the last change torn.
fn survivals(disk: &Disk) -> Vec<Survival> {
    let unsynced = disk.unsynced();
    let mut all = vec![Survival::Nothing, Survival::Everything];
    if unsynced <= SUBSETS_MAX {
        all.extend((1..(1u64 << unsynced).saturating_sub(1)).map(Survival::Mask));
    } else {
        all.extend((1..unsynced).map(Survival::First));
        all.extend((0..unsynced.min(63)).flat_map(|i| [Survival::Mask(1 << i), Survival::Mask(!(1 << i))]));
    }
    for (index, sectors) in disk.last_writes() {
        let cuts = (1..sectors).flat_map(|cut| [Survival::Torn(0, index, cut), Survival::Torn(!0, index, cut)]);
        all.extend(cuts);
    }
    all
}

/// Tries every crash point; returns the number of opened states.
pub fn every_crash_point() -> Result<u64, String> {
    let whole = Disk::new(1);
    checked(&whole, &mut Oracle::default())?;
    let mut states = 0;
    for crash_at in 1..=whole.clock() {
        let disk = Disk::new(1);
        let mut oracle = Oracle::default();
        disk.crash_at(crash_at);
        checked(&disk, &mut oracle)?;
        for survival in survivals(&disk) {
            let after = disk.fork();
            after.power_cycle(survival);
            reopen(&after, &oracle).map_err(|what| format!("change {crash_at}, {survival:?}: {what}"))?;
            states += 1;
        }
    }
    Ok(states)
}

/// All ways in which a call fails.
pub const FAULTS: [Fault; 5] = [Fault::Io, Fault::Full, Fault::TooManyFiles, Fault::Short, Fault::Interrupted];

#[derive(Debug, Default)]
pub struct Failing {
    pub calls: u64,
    /// Cases in which an error was met, for each fault of [`FAULTS`]: failing once, failing permanently.
    pub met: [[u64; 2]; 5],
}

/// Makes every call fail, once and permanently, with every fault. Then the store opens at the last acknowledged
/// generation or at the pending one, with all bytes of all kept generations, and takes another commit: both after a
/// killed process and after a power failure.
pub fn every_call_fails() -> Result<Failing, String> {
    let whole = Disk::new(1);
    checked(&whole, &mut Oracle::default())?;
    let mut failing = Failing { calls: whole.calls(), ..Failing::default() };
    for at_call in 1..=whole.calls() {
        for (way, fault) in FAULTS.into_iter().enumerate() {
            for (mode, calls) in [1, u64::MAX].into_iter().enumerate() {
                let place = format!("call {at_call}, {fault:?}, {calls} calls");
                let disk = Disk::new(1);
                let mut oracle = Oracle::default();
                disk.set_fault(Some(FaultPlan { at_call, calls, fault }));
                checked(&disk, &mut oracle).map_err(|what| format!("{place}: {what}"))?;
                failing.met[way][mode] += u64::from(disk.faults_given() > 0);
                let killed = disk.fork();
                killed.process_killed();
                reopen(&killed, &oracle).map_err(|what| format!("{place}, killed: {what}"))?;
                disk.power_cycle(Survival::Nothing);
                reopen(&disk, &oracle).map_err(|what| format!("{place}, powered off: {what}"))?;
            }
        }
    }
    Ok(failing)
}
