// Position of an invocation in its workgroup and subgroup, and sums over a subgroup.
//
// Stages use subgroups if the adapter has them, with the switch SUBGROUPS. EMULATED_SUBGROUPS computes the same in workgroup memory for
// subgroups of SUBGROUP_SIZE, so that tests can run sizes that no adapter at hand has. All invocations of a workgroup must call an
// emulated sum, so a stage leaves out what only some subgroups would call.

/// As Place.
struct SubgroupPlace {
    @builtin(local_invocation_index) lane: u32,
#ifdef SUBGROUPS
#ifndef EMULATED_SUBGROUPS
    @builtin(subgroup_id) subgroup: u32,
    @builtin(num_subgroups) subgroups: u32,
    @builtin(subgroup_invocation_id) subgroup_lane: u32,
#endif
#endif
}

#ifdef SUBGROUPS
#ifdef EMULATED_SUBGROUPS
#param SUBGROUP_SIZE 4u 8u 16u 32u 64u
var<workgroup> emulated: array<vec3<f32>, 256>;
var<workgroup> emulated_u32: array<u32, 256>;

/// Number of the invocation's subgroup in the workgroup.
fn subgroup_of(place: SubgroupPlace) -> u32 {
    return place.lane / SUBGROUP_SIZE;
}

/// Number of subgroups of a workgroup.
fn subgroups_of(place: SubgroupPlace, invocations: u32) -> u32 {
    return invocations / SUBGROUP_SIZE;
}

/// Number of the invocation in its subgroup.
fn subgroup_lane_of(place: SubgroupPlace) -> u32 {
    return place.lane % SUBGROUP_SIZE;
}

fn subgroup_sum_vec3(v: vec3<f32>, lane: u32) -> vec3<f32> {
    workgroupBarrier();
    emulated[lane] = v;
    workgroupBarrier();
    var sum = vec3<f32>();
    // Four at a time, to stay below the limit on iterations.
    for (var i = lane - lane % SUBGROUP_SIZE; i < lane - lane % SUBGROUP_SIZE + SUBGROUP_SIZE; i += 4u) {
        sum += (emulated[i] + emulated[i + 1u]) + (emulated[i + 2u] + emulated[i + 3u]);
    }
    return sum;
}

fn subgroup_sum_vec2(v: vec2<f32>, lane: u32) -> vec2<f32> {
    return subgroup_sum_vec3(vec3<f32>(v, 0.0), lane).xy;
}

/// The sum over the invocations of the subgroup before this one, and over all.
fn subgroup_scan_u32(v: u32, lane: u32) -> vec2<u32> {
    workgroupBarrier();
    emulated_u32[lane] = v;
    workgroupBarrier();
    var sums = vec2<u32>();
    for (var i = 0u; i < SUBGROUP_SIZE; i++) {
        let value = emulated_u32[lane - lane % SUBGROUP_SIZE + i];
        sums += vec2<u32>(select(0u, value, i < lane % SUBGROUP_SIZE), value);
    }
    return sums;
}
#else
/// Number of the invocation's subgroup in the workgroup.
fn subgroup_of(place: SubgroupPlace) -> u32 {
    return place.subgroup;
}

/// Number of subgroups of a workgroup.
fn subgroups_of(place: SubgroupPlace, invocations: u32) -> u32 {
    return place.subgroups;
}

/// Number of the invocation in its subgroup.
fn subgroup_lane_of(place: SubgroupPlace) -> u32 {
    return place.subgroup_lane;
}

fn subgroup_sum_vec3(v: vec3<f32>, lane: u32) -> vec3<f32> {
    return subgroupAdd(v);
}

fn subgroup_sum_vec2(v: vec2<f32>, lane: u32) -> vec2<f32> {
    return subgroupAdd(v);
}

/// The sum over the invocations of the subgroup before this one, and over all.
fn subgroup_scan_u32(v: u32, lane: u32) -> vec2<u32> {
    return vec2<u32>(subgroupExclusiveAdd(v), subgroupAdd(v));
}
#endif
#endif
