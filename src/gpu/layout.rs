//! Rust twins of WGSL structs: one macro declares the struct and the layout that `tests/shaders.rs` compares with what
//! the shader compiler computed.

/// Layout of the Rust twin of a WGSL struct.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StructLayout {
    /// Name of the struct, the same in both languages.
    pub name: &'static str,
    /// Bytes.
    pub size: usize,
    /// Name and byte offset of each field, in order.
    pub fields: &'static [(&'static str, usize)],
}

/// Declares a `#[repr(C)]` struct that can be uploaded, with its `LAYOUT`.
///
/// ```
/// gsscale::wgsl_struct! {
///     /// Uniforms of a scan.
///     pub struct ScanUniforms {
///         /// Elements.
///         pub count: u32,
///         /// Elements of one workgroup.
///         pub chunk: u32,
///     }
/// }
/// assert_eq!(ScanUniforms::LAYOUT.fields, [("count", 0), ("chunk", 4)]);
/// ```
#[macro_export]
macro_rules! wgsl_struct {
    (
        $(#[$meta:meta])*
        $vis:vis struct $name:ident {
            $( $(#[$field_meta:meta])* $field_vis:vis $field:ident : $ty:ty ),* $(,)?
        }
    ) => {
        $(#[$meta])*
        #[repr(C)]
        #[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
        $vis struct $name {
            $( $(#[$field_meta])* $field_vis $field: $ty ),*
        }

        impl $name {
            /// What the shader's struct of this name must look like.
            $vis const LAYOUT: $crate::gpu::StructLayout = $crate::gpu::StructLayout {
                name: stringify!($name),
                size: std::mem::size_of::<$name>(),
                fields: &[ $( (stringify!($field), std::mem::offset_of!($name, $field)) ),* ],
            };
        }
    };
}
