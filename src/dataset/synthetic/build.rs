//! Builds the city: chooses the kind of each plot, and places its parts.
//!
//! Invariant: a plot, street or field takes its random draws from a stream keyed by its own number, so that it does not
//! depend on the order of construction.

use super::parts::{Parts, grass, skin};
use super::texture::{Material, Noise, Skin, paint};
use super::world::{CityPlot, HALF_ROAD, HALF_STREET, MARGIN, PITCH, Patch, World};
use crate::base::rng::{Purpose, Stream};
use glam::DVec3;

const HALF_PLOT: f64 = 0.5 * PITCH - HALF_STREET;

pub(super) fn build_city(seed: u64, blocks: u32) -> World {
    let noise = Noise::new(seed);
    let mut world = World { seed, blocks, noise, solids: Vec::new(), plots: Vec::new() };
    let half = world.half();
    let middle = 0.5 * f64::from(blocks);
    for j in 0..blocks {
        for i in 0..blocks {
            let number = (u64::from(i) << 32) | u64::from(j);
            let mut parts = Parts::new(Stream::new(seed, Purpose::City, number, 1));
            let centre = [(f64::from(i) + 0.5) * PITCH - half, (f64::from(j) + 0.5) * PITCH - half];
            let (a, b) = (f64::from(i) + 0.5 - middle, f64::from(j) + 0.5 - middle);
            let from_middle = (a * a + b * b).sqrt() / middle.max(1.0);
            let tall = parts.draws.uniform() > 0.25 + 0.8 * from_middle;
            // The slot gives neighbours different kinds.
            world.plots.push(match (i + 2 * j) % 5 {
                slot if tall && slot != 3 => offices(&mut parts, centre),
                0 | 4 => terraces(&mut parts, centre),
                1 => houses(&mut parts, centre),
                2 if parts.draws.uniform() < 0.5 => offices(&mut parts, centre),
                2 => houses(&mut parts, centre),
                _ => park(&mut parts, centre),
            });
            world.solids.append(&mut parts.solids);
        }
    }
    for k in 0..=blocks {
        for along_y in [true, false] {
            let mut parts = Parts::new(Stream::new(seed, Purpose::City, u64::from(k), if along_y { 2 } else { 3 }));
            furnish_street(&mut parts, f64::from(k) * PITCH - half, half, along_y);
            world.solids.append(&mut parts.solids);
        }
    }
    plant_countryside(&mut world);
    world
}

fn rectangle(centre: [f64; 2], half: [f64; 2], skin: Skin) -> Patch {
    Patch { low: [centre[0] - half[0], centre[1] - half[1]], high: [centre[0] + half[0], centre[1] + half[1]], skin }
}

/// Six houses with gardens.
fn houses(parts: &mut Parts, centre: [f64; 2]) -> CityPlot {
    let mut plot = CityPlot { base: grass(parts), patches: Vec::new() };
    let lot = 2.0 * HALF_PLOT / 3.0;
    let hedge = parts.leaf_skin();
    for row in [-1.0, 1.0] {
        for column in [-1.0, 0.0, 1.0] {
            let (x, y) = (centre[0] + column * lot, centre[1] + row * 0.5 * HALF_PLOT);
            house_lot(parts, &mut plot, x, y, row, lot);
        }
        for column in [-0.5, 0.5] {
            let at = DVec3::new(centre[0] + column * lot, centre[1] + row * 0.5 * HALF_PLOT, 0.0);
            parts.hedge(at, 0.4, 0.5 * HALF_PLOT - 1.0, hedge);
        }
    }
    parts.hedge(DVec3::new(centre[0], centre[1], 0.0), HALF_PLOT - 0.5, 0.4, hedge);
    plot
}

/// One house with its garden. `row` is -1 if the street is south of the house, 1 if it is north.
fn house_lot(parts: &mut Parts, plot: &mut CityPlot, x: f64, y: f64, row: f64, lot: f64) {
    let d = &mut parts.draws;
    let (half_x, half_y) = (d.range(3.6, 4.8), d.range(4.0, 5.2));
    let turn = if d.uniform() < 0.6 { 0.0 } else { d.range(-0.09, 0.09) };
    let side = if d.uniform() < 0.5 { 1.0 } else { -1.0 };
    let front = y + row * (0.5 * HALF_PLOT - half_y - d.range(3.0, 4.5));
    let house_x = x - side * d.range(0.9, 1.6);
    let drive_x = x + side * (0.5 * lot - 1.9);
    let (pool, beds) = (d.uniform() < 0.3, d.uniform() < 0.4);
    let drive = skin(parts, Material::Paving, paint(0.56, 0.53, 0.5), paint(0.5, 0.46, 0.42));
    plot.patches.push(rectangle([drive_x, y + row * 0.27 * HALF_PLOT], [1.5, 0.23 * HALF_PLOT], drive));
    plot.patches.push(rectangle([house_x, front - row * (half_y + 1.5)], [half_x, 1.6], drive));
    plot.patches.push(rectangle([house_x, y + row * (0.5 * HALF_PLOT - 1.5)], [0.7, 1.6], drive));
    parts.house(DVec3::new(house_x, front, 0.0), half_x, half_y, turn);
    if parts.draws.uniform() < 0.7 {
        parts.car(DVec3::new(drive_x, y + row * (0.5 * HALF_PLOT - 4.0), 0.0), true);
    }
    let garden = y - row * 0.28 * HALF_PLOT;
    if pool {
        let rim = skin(parts, Material::Paving, paint(0.74, 0.71, 0.65), paint(0.68, 0.65, 0.6));
        let water = skin(parts, Material::Pool, paint(0.3, 0.62, 0.72), paint(0.3, 0.6, 0.7));
        plot.patches.push(rectangle([x + side, garden], [3.4, 2.4], rim));
        plot.patches.push(rectangle([x + side, garden], [2.6, 1.6], water));
    } else if beds {
        let bed = skin(parts, Material::Crop, paint(0.36, 0.45, 0.22), paint(0.42, 0.33, 0.25));
        plot.patches.push(rectangle([x - side * 2.0, garden], [3.0, 1.8], bed));
    }
    if parts.draws.uniform() < 0.5 {
        parts.shed(DVec3::new(x - side * (0.5 * lot - 2.4), y - row * (0.5 * HALF_PLOT - 2.4), 0.0));
    }
    for _ in 0..1 + parts.draws.below(3) {
        let d = &mut parts.draws;
        let at = DVec3::new(x + d.range(-0.4, 0.4) * lot, y - row * d.range(0.18, 0.45) * HALF_PLOT, 0.0);
        let size = d.range(0.6, 1.0);
        parts.tree(at, size);
    }
}

fn terraces(parts: &mut Parts, centre: [f64; 2]) -> CityPlot {
    let court = skin(parts, Material::Paving, paint(0.6, 0.56, 0.5), paint(0.54, 0.5, 0.45));
    let lawn = grass(parts);
    let mut plot =
        CityPlot { base: court, patches: vec![rectangle(centre, [HALF_PLOT - 14.5, HALF_PLOT - 14.5], lawn)] };
    let path = skin(parts, Material::Earth, paint(0.68, 0.62, 0.5), paint(0.6, 0.55, 0.45));
    plot.patches.push(rectangle(centre, [1.1, HALF_PLOT - 14.5], path));
    if parts.draws.uniform() < 0.6 {
        let sand = skin(parts, Material::Earth, paint(0.78, 0.7, 0.54), paint(0.7, 0.6, 0.5));
        plot.patches.push(rectangle([centre[0] + 4.5, centre[1] - 3.0], [2.8, 2.4], sand));
    }
    let depth = 5.6;
    let inset = HALF_PLOT - depth - 0.8;
    for (dx, dy) in [(0.0, -inset), (0.0, inset)] {
        parts.flats(DVec3::new(centre[0] + dx, centre[1] + dy, 0.0), HALF_PLOT - 0.8, depth, false);
    }
    let short = HALF_PLOT - 2.0 * depth - 4.0;
    for dx in [-inset, inset] {
        if parts.draws.uniform() < 0.75 {
            parts.flats(DVec3::new(centre[0] + dx, centre[1], 0.0), short, depth, true);
        }
    }
    for k in 0..7 {
        let d = &mut parts.draws;
        let side = if k % 2 == 0 { -1.0 } else { 1.0 };
        let at = DVec3::new(centre[0] + side * d.range(2.5, HALF_PLOT - 16.0), centre[1] + d.range(-7.5, 7.5), 0.0);
        let size = d.range(0.7, 1.15);
        parts.tree(at, size);
    }
    plot
}

/// Office buildings; one quarter of the plot is a car park.
fn offices(parts: &mut Parts, centre: [f64; 2]) -> CityPlot {
    let base = skin(parts, Material::Paving, paint(0.66, 0.64, 0.6), paint(0.58, 0.55, 0.52));
    let mut plot = CityPlot { base, patches: Vec::new() };
    let parking = parts.draws.below(4);
    let quarter = 0.5 * HALF_PLOT;
    for k in 0..4u64 {
        let (sx, sy) = (if k & 1 == 0 { -1.0 } else { 1.0 }, if k & 2 == 0 { -1.0 } else { 1.0 });
        let at = DVec3::new(centre[0] + sx * quarter, centre[1] + sy * quarter, 0.0);
        if k == parking {
            car_park(parts, &mut plot, at, quarter - 0.6);
            continue;
        }
        if parts.draws.uniform() < 0.12 {
            let (half, lawn) = (quarter - 1.5, grass(parts));
            plot.patches.push(rectangle([at.x, at.y], [half, half], lawn));
            for _ in 0..5 {
                let d = &mut parts.draws;
                let tree = at + DVec3::new(d.range(-0.8, 0.8) * half, d.range(-0.8, 0.8) * half, 0.0);
                let size = d.range(0.8, 1.3);
                parts.tree(tree, size);
            }
            continue;
        }
        let d = &mut parts.draws;
        let (half_x, half_y) = (d.range(7.2, quarter - 1.4), d.range(7.2, quarter - 1.4));
        let height = if d.uniform() < 0.3 { d.range(21.0, 31.0) } else { d.range(9.0, 19.0) };
        let height = (height / 3.3).floor() * 3.3;
        let kerb = grass(parts);
        plot.patches.push(rectangle([at.x, at.y], [half_x + 1.2, half_y + 1.2], kerb));
        parts.office(at, half_x, half_y, height);
    }
    plot
}

fn car_park(parts: &mut Parts, plot: &mut CityPlot, at: DVec3, half: f64) {
    let surface = skin(parts, Material::Asphalt, paint(0.4, 0.4, 0.4), paint(0.8, 0.8, 0.78));
    plot.patches.push(rectangle([at.x, at.y], [half, half], surface));
    let bays = (2.0 * half / 2.6) as u32;
    for (row, y) in [(0u32, 2.8), (1, 13.8), (2, 18.8)] {
        for k in 1..bays {
            if 2.6 * f64::from(k) < 2.0 * half - 1.5 && parts.draws.uniform() < 0.6 && y + 2.2 < 2.0 * half {
                let dx = parts.draws.range(-0.15, 0.15);
                let x = at.x - half + 2.6 * (f64::from(k) - 0.5) + dx;
                let wobble = parts.draws.range(-0.3, 0.3) + 0.1 * f64::from(row);
                parts.car(DVec3::new(x, at.y - half + y + wobble, 0.0), true);
            }
        }
    }
}

/// A park: lawn, paths, flower beds, a sports court, trees, a pavilion.
fn park(parts: &mut Parts, centre: [f64; 2]) -> CityPlot {
    let mut plot = CityPlot { base: grass(parts), patches: Vec::new() };
    let path = skin(parts, Material::Earth, paint(0.72, 0.66, 0.54), paint(0.6, 0.55, 0.45));
    plot.patches.push(rectangle(centre, [1.4, HALF_PLOT], path));
    plot.patches.push(rectangle([centre[0], centre[1] + 3.0], [HALF_PLOT, 1.4], path));
    plot.patches.push(rectangle([centre[0], centre[1] + 3.0], [6.0, 6.0], path));
    let beds = skin(parts, Material::Crop, paint(0.72, 0.4, 0.42), paint(0.4, 0.46, 0.24));
    for (dx, dy) in [(-3.2, 6.2), (3.2, 6.2), (-3.2, -0.2), (3.2, -0.2)] {
        plot.patches.push(rectangle([centre[0] + dx, centre[1] + dy], [1.5, 1.5], beds));
    }
    let d = &mut parts.draws;
    let side = if d.uniform() < 0.5 { 1.0 } else { -1.0 };
    let (ground, line) = if d.uniform() < 0.5 {
        (paint(0.66, 0.4, 0.32), paint(0.36, 0.48, 0.36))
    } else {
        (paint(0.3, 0.45, 0.6), paint(0.36, 0.5, 0.38))
    };
    let court = skin(parts, Material::Court, ground, line);
    let (court_x, court_y) = (centre[0] + side * 13.0, centre[1] - 11.0);
    plot.patches.push(rectangle([court_x, court_y], [7.5, 9.5], court));
    parts.shed(DVec3::new(centre[0] - side * 6.5, centre[1] - 6.5, 0.0));
    let mut planted = 0;
    for _ in 0..70 {
        let d = &mut parts.draws;
        let (x, y) = (d.range(-1.0, 1.0) * (HALF_PLOT - 2.0), d.range(-1.0, 1.0) * (HALF_PLOT - 2.0));
        let size = d.range(0.75, 1.4);
        let on_path = x.abs() < 4.0 || (y - 3.0).abs() < 4.0 || (x.abs() < 9.0 && (y - 3.0).abs() < 9.0);
        let on_court = (centre[0] + x - court_x).abs() < 9.5 && (centre[1] + y - court_y).abs() < 11.5;
        // One clearing stays without trees.
        let clearing = (x + side * 13.0).abs() < 8.0 && (y + 12.0).abs() < 8.0;
        if !on_path && !on_court && !clearing && planted < 24 {
            parts.tree(DVec3::new(centre[0] + x, centre[1] + y, 0.0), size);
            planted += 1;
        }
    }
    plot
}

/// Adds trees, lamps, and parked and driving cars to one street.
fn furnish_street(parts: &mut Parts, line: f64, half: f64, along_y: bool) {
    let place = |across: f64, along: f64| {
        if along_y { DVec3::new(line + across, along, 0.0) } else { DVec3::new(along, line + across, 0.0) }
    };
    let blocks = (2.0 * half / PITCH) as u32;
    for block in 0..blocks {
        let start = f64::from(block) * PITCH - half;
        let leafy = parts.draws.uniform() < 0.65;
        for k in 0..5 {
            let along = start + HALF_STREET + 6.0 + f64::from(k) * 8.6;
            for side in [-1.0, 1.0] {
                if leafy && parts.draws.uniform() < 0.62 {
                    let size = parts.draws.range(0.5, 0.8);
                    parts.tree(place(side * (HALF_ROAD + 1.5), along), size);
                }
                if k % 2 == 1 {
                    parts.lamp(place(side * (HALF_ROAD + 0.5), along + 4.3));
                }
                if parts.draws.uniform() < 0.3 {
                    let wobble = parts.draws.range(-1.2, 1.2);
                    parts.car(place(side * 3.0, along + 2.5 + wobble), along_y);
                }
                if parts.draws.uniform() < 0.1 {
                    let wobble = parts.draws.range(-2.0, 2.0);
                    parts.car(place(side * 1.15, along + wobble), along_y);
                }
            }
        }
    }
}

/// Adds trees and a few barns to the land around the city.
fn plant_countryside(world: &mut World) {
    let reach = world.half() + MARGIN;
    let cell = 30.0;
    let cells = (2.0 * reach / cell) as u64;
    let mut solids = Vec::new();
    for j in 0..cells {
        for i in 0..cells {
            let mut parts = Parts::new(Stream::new(world.seed, Purpose::City, (i << 32) | j, 4));
            let corner = DVec3::new(i as f64 * cell - reach, j as f64 * cell - reach, 0.0);
            let kind = parts.draws.uniform();
            let trees = if kind < 0.12 { 9 } else { u32::from(kind < 0.5) + u32::from(kind < 0.3) };
            for _ in 0..trees {
                let at = corner + DVec3::new(parts.draws.range(0.0, cell), parts.draws.range(0.0, cell), 0.0);
                let size = parts.draws.range(0.7, 1.3);
                if world.is_open_land(at) {
                    parts.tree(at, size);
                }
            }
            let barn = corner + DVec3::new(0.5 * cell, 0.5 * cell, 0.0);
            let clear = [(-11.0, -11.0), (11.0, -11.0), (-11.0, 11.0), (11.0, 11.0)];
            if kind > 0.94 && clear.iter().all(|&(x, y)| world.is_open_land(barn + DVec3::new(x, y, 0.0))) {
                let turn = parts.draws.range(-0.7, 0.7);
                parts.barn(barn, turn);
            }
            solids.append(&mut parts.solids);
        }
    }
    world.solids.append(&mut solids);
}
