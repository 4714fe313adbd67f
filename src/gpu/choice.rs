//! The device that a user requests. Exists in programs without GPU support too: configs name it.

/// The device that the user requests.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum DeviceChoice {
    /// The best hardware GPU; [`super::GpuError::NoHardwareGpu`] if there is none.
    Auto,
    /// The best adapter, even a software one.
    Gpu,
    /// The best adapter whose name contains this text, ignoring case.
    Named(String),
}
