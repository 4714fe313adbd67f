//! Rust twins of WGSL structs: one macro declares the struct and its layout, which `tests/numerics/shaders.rs` compares
//! with the layout computed by the shader compiler.

/// Layout of the Rust twin of a WGSL struct.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StructLayout {
    /// Name of the struct, the same in both languages.
    pub name: &'static str,
    /// Size, bytes.
    pub size: usize,
    /// Name and byte offset of each field, in order.
    pub fields: &'static [(&'static str, usize)],
}

/// Declares uploadable `#[repr(C)]` structs, each with its `LAYOUT`.
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
    ($(
        $(#[$meta:meta])*
        $vis:vis struct $name:ident {
            $( $(#[$field_meta:meta])* $field_vis:vis $field:ident : $ty:ty ),* $(,)?
        }
    )+) => {$(
        $(#[$meta])*
        #[repr(C)]
        #[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
        $vis struct $name {
            $( $(#[$field_meta])* $field_vis $field: $ty ),*
        }

        impl $name {
            /// The layout that the shader's struct of this name must have.
            $vis const LAYOUT: $crate::gpu::StructLayout = $crate::gpu::StructLayout {
                name: stringify!($name),
                size: std::mem::size_of::<$name>(),
                fields: &[ $( (stringify!($field), std::mem::offset_of!($name, $field)) ),* ],
            };
        }
    )+};
}
