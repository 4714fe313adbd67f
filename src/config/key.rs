//! What is known of a key beside its value: where it stands in help, what it means, and what a change of it means.

/// A key of the config.
#[derive(Debug, Clone, Copy)]
pub struct Key {
    /// The group of keys that it is listed in.
    pub heading: &'static str,
    /// The field of [`super::file::TrainConfig`], which is the id of the flag as well.
    pub field: &'static str,
    /// Its meaning, for help and for configs/default.toml.
    pub meaning: &'static str,
    /// What a change of it means.
    pub class: Class,
}

impl Key {
    /// The name in files and on the command line: kebab-case.
    pub fn name(&self) -> String {
        self.field.replace('_', "-")
    }
}

/// What a change of a key means: for a run that goes on with other settings, and for a run that is compared with a
/// published one.
///
/// | class | on `--resume` | beside a published run |
/// | --- | --- | --- |
/// | `Numbers` | refused without `--accept-changes` | another run |
/// | `Layout` | refused | another run |
/// | `Derived` | what follows from it is compared, not the key | another run |
/// | `Instructions` | what follows from it is compared, not the key | the same run |
/// | `Place` | refused without `--accept-changes` | the same run |
/// | `Free` | said; holds for this life of the run alone | the same run |
/// | `Lasting` | said; holds for all later lives | the same run |
/// | `Reported` | said; holds for this life of the run alone | another figure |
/// | `Length` | said; holds for all later lives | another run |
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Class {
    /// Changes the numbers of the steps.
    Numbers,
    /// The stored pages are laid out by it.
    Layout,
    /// Another value may mean the same: of `schedule-steps` the steps that it stands for are compared, of `init-ply` the
    /// digest of first Gaussians, wherever the file lies now.
    Derived,
    /// The instruction path: as [`Class::Derived`], and at most the last bits differ, as they do with another seed.
    Instructions,
    /// Where the dataset is found, and whether it may be incomplete.
    Place,
    /// Where and how fast a run computes, or what it writes.
    Free,
    /// As [`Class::Free`], for what a run keeps.
    Lasting,
    /// Changes no Gaussian, but a figure that is reported.
    Reported,
    /// How far a run goes; what its rates follow is `schedule-steps`.
    Length,
}

impl Class {
    /// Whether a run may go on with another value without being asked: no step computes other numbers.
    pub fn is_free(self) -> bool {
        matches!(self, Class::Free | Class::Lasting | Class::Reported | Class::Length)
    }

    /// Whether another value holds for all later lives of a run, not for this life alone. Free keys may not.
    pub fn lasts(self) -> bool {
        !matches!(self, Class::Free | Class::Reported)
    }

    /// Whether what follows from the value is compared instead of the value.
    pub fn is_derived(self) -> bool {
        matches!(self, Class::Derived | Class::Instructions)
    }

    /// Whether another value makes a run another one than a published run, or its figures other figures.
    pub fn makes_another_run(self) -> bool {
        !matches!(self, Class::Free | Class::Lasting | Class::Place | Class::Instructions)
    }
}
