//! Pins the memory layout that `docs/CONTRACT.md` promises to writers in other languages.

use std::mem::{align_of, offset_of, size_of};
