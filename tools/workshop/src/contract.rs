//! `flockeye contract`: the contract's types, codes and topics for another language.

use clap::{Args, ValueEnum};
use flockeye_cli::Screen;
use flockeye_contract::description;

/// Arguments of `contract`.
#[derive(Debug, Args)]
pub(crate) struct ContractArguments {
    /// In which form.
    #[arg(value_enum)]
    pub form: Form,
}

/// A form of the contract.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Form {
    /// A header, with static assertions.
    C,
    /// A module for ctypes.
    Python,
    /// Sizes, alignments and offsets as text.
    Layout,
}

/// Prints it.
///
/// # Errors
/// None.
pub(crate) fn run(arguments: &ContractArguments) -> anyhow::Result<()> {
    let text = match arguments.form {
        Form::C => description::c_header(),
        Form::Python => description::python_module(),
        Form::Layout => description::layout(),
    };
    Screen::new().line(text.trim_end());
    Ok(())
}
