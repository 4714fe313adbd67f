//! Bytes over the bus and on the device, for reports. Zeros in programs without GPU support.

/// Traffic over the bus since the device was opened, and memory.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Traffic {
    /// Bytes from the host to the device: uploads and uniforms.
    pub bytes_uploaded: u64,
    /// Bytes from the device to the host.
    pub bytes_read_back: u64,
    /// Device memory of live buffers, staging and uniforms, bytes.
    pub device_bytes: u64,
    /// Most device memory ever allocated, bytes, including free buffers in the pool.
    pub device_bytes_peak: u64,
    /// Buffers allocated so far: constant once warmed up.
    pub device_allocations: u64,
    /// The part of this memory that stages uploads, uniforms and read-backs, bytes. It may lie in host memory.
    pub staging_bytes: u64,
}
