// Position of an invocation in a dispatch that may be folded into two dimensions (beyond 65,535 workgroups).

/// What an entry point knows of its workgroup: the same for all of its invocations, which compilers see only in a struct of its own.
struct Group {
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) count: vec3<u32>,
}

/// What an entry point knows of its invocation.
struct Place {
    /// Number of the invocation in its workgroup.
    @builtin(local_invocation_index) lane: u32,
}

/// Index of the workgroup, as if the dispatch had one dimension. The last row may contain workgroups beyond the work:
/// the caller compares the index with its count.
fn linear_group(workgroup: Group) -> u32 {
    return workgroup.id.x + workgroup.id.y * workgroup.count.x;
}

/// Index of the invocation in workgroups of `size`.
fn linear_index(workgroup: Group, place: Place, size: u32) -> u32 {
    return linear_group(workgroup) * size + place.lane;
}
