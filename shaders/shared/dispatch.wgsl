// Position of an invocation in a dispatch that may be folded into two dimensions (beyond 65,535 workgroups).

/// What an entry point knows of its invocation.
struct Place {
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    /// Number of the invocation in its workgroup.
    @builtin(local_invocation_index) lane: u32,
}

/// Index of the workgroup, as if the dispatch had one dimension. The last row may contain workgroups beyond the work:
/// the caller compares the index with its count.
fn linear_group(workgroup: vec3<u32>, workgroups: vec3<u32>) -> u32 {
    return workgroup.x + workgroup.y * workgroups.x;
}

/// Index of the invocation in workgroups of `size`.
fn linear_index(place: Place, size: u32) -> u32 {
    return linear_group(place.workgroup, place.workgroups) * size + place.lane;
}
