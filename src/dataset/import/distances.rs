//! Distances to the nearest neighbours in a cloud larger than memory: block by block, and across blocks whose boxes are
//! near enough.
//!
//! Invariant: the distances are those of [`crate::scene::neighbours::nearest_dist2`] over the whole cloud, bit for bit,
//! for any memory budget: a neighbour in another block can be nearer than the third nearest in the own block only if
//! that block's box is.

use super::divide::Division;
use super::spool::{Spool, SpoolWriter};
use super::{Budget, CloudPoint};
use crate::base::error::InputResult;
use crate::scene::init::rms_distance;
use crate::scene::neighbours::{NEIGHBOURS, NeighbourTree, merged};
use crate::scene::partition::Pages;
use rayon::prelude::*;
use std::ops::Range;

/// Bytes per point while its block is searched: record, position, tree, distances.
const SEARCH_BYTES: usize = 96;

#[derive(Clone, Copy, bytemuck::Zeroable, bytemuck::Pod)]
#[repr(C)]
struct Query {
    point: [f32; 3],
    /// Only points nearer than this matter.
    limit: f32,
    /// Index of the querying point in the sorted cloud.
    at: u32,
    block: u32,
}

#[derive(Clone, Copy, bytemuck::Zeroable, bytemuck::Pod)]
#[repr(C)]
struct Answer {
    at: u32,
    dist2: [f32; NEIGHBOURS],
}

/// The cloud in spatial order, and for each point the root mean square distance to its neighbours.
pub(super) fn measure(points: Spool<CloudPoint>, budget: &Budget<'_>) -> InputResult<(Spool<CloudPoint>, Spool<f64>)> {
    let pages = Pages::of(points.len(), budget.records(SEARCH_BYTES));
    let blocks: Vec<Range<usize>> = (0..pages.pages).map(|b| pages.start(b)..pages.start(b + 1)).collect();
    let space = budget.space();
    let mut sorted = SpoolWriter::new(space);
    let division = Division { space, pages, records_in_memory: pages.rows.div_ceil(pages.pages.max(1)) };
    division.run(points, &mut |_, entries| entries.into_iter().try_for_each(|e| sorted.push(e)))?;
    let points = sorted.finish()?;
    let positions = |block: &Range<usize>| -> InputResult<Vec<[f32; 3]>> {
        Ok(points.range(block.clone())?.iter().map(|p| p.point).collect())
    };

    // Distances within each block.
    let (mut own, mut bounds) = (SpoolWriter::new(space), Vec::with_capacity(blocks.len()));
    for block in &blocks {
        let tree = NeighbourTree::new(&positions(block)?);
        bounds.push(tree.bounds());
        tree.nearest_dist2().into_iter().try_for_each(|dist2| own.push(dist2))?;
    }
    let own: Spool<[f32; NEIGHBOURS]> = own.finish()?;

    // The queries of all points whose third neighbour is farther than another block's box.
    let mut queries = SpoolWriter::new(space);
    for (from, block) in blocks.iter().enumerate() {
        for (i, (point, dist2)) in positions(block)?.into_iter().zip(own.range(block.clone())?).enumerate() {
            let limit = dist2[NEIGHBOURS - 1];
            for (to, other) in bounds.iter().enumerate() {
                if to != from && other.dist2(point) < limit {
                    queries.push(Query { point, limit, at: (block.start + i) as u32, block: to as u32 })?;
                }
            }
        }
    }
    let queries = queries.finish()?;

    // Answers, block by block. A batch has as many queries as a block has points: a query is smaller than a point's memory.
    let mut answers = SpoolWriter::new(space);
    for (number, block) in blocks.iter().enumerate().filter(|_| !queries.is_empty()) {
        let tree = NeighbourTree::new(&positions(block)?);
        let mut batch = Vec::new();
        let mut reply = |batch: &mut Vec<Query>| {
            let known = batch.par_iter().map(|q| Answer { at: q.at, dist2: tree.nearer(q.point, q.limit) });
            let known: Vec<Answer> = known.collect();
            batch.clear();
            known.into_iter().filter(|a| a.dist2[0].is_finite()).try_for_each(|a| answers.push(a))
        };
        queries.for_each(|q| {
            if q.block as usize == number {
                batch.push(*q);
            }
            if batch.len() >= block.len().max(64) { reply(&mut batch) } else { Ok(()) }
        })?;
        reply(&mut batch)?;
    }
    let answers = answers.finish()?;

    let mut distances = SpoolWriter::new(space);
    for block in &blocks {
        let mut dist2 = own.range(block.clone())?;
        answers.for_each(|a| {
            if block.contains(&(a.at as usize)) {
                let of_point = &mut dist2[a.at as usize - block.start];
                *of_point = merged(*of_point, a.dist2);
            }
            Ok(())
        })?;
        dist2.iter().try_for_each(|d| distances.push(rms_distance(d)))?;
    }
    Ok((points, distances.finish()?))
}
