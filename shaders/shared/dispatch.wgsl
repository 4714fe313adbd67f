// Position of an invocation in a dispatch that may be folded into two dimensions (beyond 65,535 workgroups).

// Index of the workgroup, as if the dispatch had one dimension. The last row may contain workgroups beyond the work:
// the caller compares the index with its count.
fn linear_group(workgroup_id: vec3<u32>, num_workgroups: vec3<u32>) -> u32 {
    return workgroup_id.x + workgroup_id.y * num_workgroups.x;
}

// Index of the invocation in workgroups of `size`.
fn linear_index(workgroup_id: vec3<u32>, num_workgroups: vec3<u32>, local_index: u32, size: u32) -> u32 {
    return linear_group(workgroup_id, num_workgroups) * size + local_index;
}
