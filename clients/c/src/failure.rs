//! What the functions return, and why the last one failed.

use std::cell::RefCell;
use std::ffi::{CString, c_char, c_int};

/// It was done.
pub const OK: c_int = 0;
/// Nothing waits.
pub const NOTHING: c_int = 1;
/// It failed; [`flockeye_error`] says why.
pub const FAILED: c_int = -1;

thread_local! {
    static LAST: RefCell<CString> = RefCell::default();
}

/// Notes why something failed.
pub(crate) fn note(error: &anyhow::Error) {
    let text = format!("{error:#}").replace('\0', "?");
    LAST.with(|last| *last.borrow_mut() = CString::new(text).unwrap_or_default());
}

/// Forgets why something failed.
pub(crate) fn forget() {
    LAST.with(|last| *last.borrow_mut() = CString::default());
}

/// Why something failed since [`forget`]; empty if nothing did.
pub(crate) fn last() -> String {
    LAST.with(|last| last.borrow().to_string_lossy().into_owned())
}

/// The value of a call that returns a code.
pub(crate) fn code(result: anyhow::Result<c_int>) -> c_int {
    result.inspect_err(note).unwrap_or(FAILED)
}

/// The value of a call that returns something that the caller must close.
pub(crate) fn handle<T>(result: anyhow::Result<T>) -> *mut T {
    match result {
        Ok(value) => Box::into_raw(Box::new(value)),
        Err(error) => {
            note(&error);
            std::ptr::null_mut()
        }
    }
}

/// Why the last call of this thread failed. Valid until the next call.
#[unsafe(no_mangle)]
pub extern "C" fn flockeye_error() -> *const c_char {
    LAST.with(|last| last.borrow().as_ptr())
}
