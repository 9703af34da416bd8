//! `flockeye contract`: the contract's types, codes and topics for another language.

use clap::ValueEnum;
use flockeye_cli::Screen;
use flockeye_contract::description;

/// A form of the contract.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum ContractForm {
    /// A header, with static assertions.
    C,
    /// A module for ctypes.
    Python,
    /// Sizes, alignments and offsets as text.
    Layout,
}

/// Prints the contract.
pub(crate) fn print(form: ContractForm) {
    let text = match form {
        ContractForm::C => description::c_header(),
        ContractForm::Python => description::python_module(),
        ContractForm::Layout => description::layout(),
    };
    Screen::new().line(text.trim_end());
}
