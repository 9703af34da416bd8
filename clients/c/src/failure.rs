//! Return codes of the functions, and the reason of the last failure.

use std::cell::RefCell;
use std::ffi::{CString, c_char, c_int};

/// Success.
pub const OK: c_int = 0;
/// No message is waiting.
pub const NOTHING: c_int = 1;
/// Failure; [`flockeye_error`] gives the reason.
pub const FAILED: c_int = -1;

thread_local! {
    static LAST: RefCell<CString> = RefCell::default();
}

/// Keeps the reason of a failure.
pub(crate) fn note(error: &anyhow::Error) {
    let text = format!("{error:#}").replace('\0', "?");
    LAST.with(|last| *last.borrow_mut() = CString::new(text).unwrap_or_default());
}

/// Clears the reason of the last failure.
pub(crate) fn forget() {
    LAST.with(|last| *last.borrow_mut() = CString::default());
}

/// The reason of the last failure since [`forget`]; empty if there was none.
pub(crate) fn last() -> String {
    LAST.with(|last| last.borrow().to_string_lossy().into_owned())
}

/// Return code of a call.
pub(crate) fn code(result: anyhow::Result<c_int>) -> c_int {
    result.inspect_err(note).unwrap_or(FAILED)
}

/// Return pointer of a call; the caller must close what it points to.
pub(crate) fn handle<T>(result: anyhow::Result<T>) -> *mut T {
    match result {
        Ok(value) => Box::into_raw(Box::new(value)),
        Err(error) => {
            note(&error);
            std::ptr::null_mut()
        }
    }
}

/// The reason why the last call of this thread failed. Valid until the next call.
#[unsafe(no_mangle)]
pub extern "C" fn flockeye_error() -> *const c_char {
    LAST.with(|last| last.borrow().as_ptr())
}
