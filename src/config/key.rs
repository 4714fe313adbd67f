//! A key's heading in help, its meaning, its class (the effect of a change), and where help shows it.

#[derive(Debug, Clone, Copy)]
pub struct Key {
    pub heading: &'static str,
    /// Its field in [`super::file::TrainConfig`], also the id of the flag.
    pub field: &'static str,
    /// Its meaning, for help and for configs/default.toml.
    pub meaning: &'static str,
    pub class: Class,
    pub shown: Shown,
}

impl Key {
    /// Its name in files and on the command line, in kebab-case.
    pub fn name(&self) -> String {
        self.field.replace('_', "-")
    }
}

/// Where help shows a key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shown {
    /// In `-h` and in `--help`: most runs give it.
    First,
    /// In `--help`.
    InGroup,
    /// In configs/README.md and configs/default.toml alone: it is for work on the program, and for comparisons.
    Nowhere,
}

/// The effect of a changed key on a resumed run, and on the comparison with a published run.
///
/// | class | on `--resume` | compared with a published run |
/// | --- | --- | --- |
/// | `Numbers` | refused without `--accept-changes` | another run |
/// | `Layout` | refused | another run |
/// | `Derived` | its derived value is compared | another run |
/// | `Instructions` | its derived value is compared | the same run |
/// | `Place` | refused without `--accept-changes` | the same run |
/// | `Free` | reported; valid until the next resume | the same run |
/// | `Lasting` | reported; kept for later resumes | the same run |
/// | `Reported` | reported; valid until the next resume | another figure |
/// | `Length` | reported; kept for later resumes | another run |
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Class {
    /// Changes the numbers of the steps.
    Numbers,
    /// Determines the layout of stored pages.
    Layout,
    /// Different values can have the same effect: for `schedule-steps` the resolved steps are compared, for `init-ply`
    /// the digest of the first Gaussians.
    Derived,
    /// The instruction path: as [`Class::Derived`]; results differ at most in rounding.
    Instructions,
    /// Location of the dataset, and whether it may be incomplete.
    Place,
    /// Resources, speed and outputs of a run.
    Free,
    /// As [`Class::Free`], for the place and the keeping of the checkpoint.
    Lasting,
    /// Changes a reported figure but no Gaussian.
    Reported,
    /// Number of steps. The learning rates follow `schedule-steps` instead.
    Length,
}

impl Class {
    /// Whether a run may resume with another value without --accept-changes, because no step computes other numbers.
    pub fn is_free(self) -> bool {
        matches!(self, Class::Free | Class::Lasting | Class::Reported | Class::Length)
    }

    /// Whether another value is kept for later resumes.
    pub fn lasts(self) -> bool {
        !matches!(self, Class::Free | Class::Reported)
    }

    /// Whether the derived value is compared instead of the key.
    pub fn is_derived(self) -> bool {
        matches!(self, Class::Derived | Class::Instructions)
    }

    /// Whether another value makes a run or its figures differ from a published run.
    pub fn makes_another_run(self) -> bool {
        !matches!(self, Class::Free | Class::Lasting | Class::Place | Class::Instructions)
    }
}
