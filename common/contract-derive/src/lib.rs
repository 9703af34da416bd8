//! `#[derive(Described)]`: describes a type of the contract as data, so that its fields are listed
//! only once.
//!
//! It names paths of `flockeye-contract` and works there only. The clients in other languages, the
//! messages of recordings and the layout in `docs/CONTRACT.md` are made from what it describes.

use proc_macro::TokenStream;
use quote::quote;
use syn::{Data, DeriveInput, Error, Fields, parse_macro_input};

/// Implements `Described` for a struct with named fields: the name, offset and kind of each.
#[proc_macro_derive(Described)]
pub fn described(input: TokenStream) -> TokenStream {
    let input = parse_macro_input!(input as DeriveInput);
    described_fields(&input).unwrap_or_else(|error| error.to_compile_error()).into()
}

fn described_fields(input: &DeriveInput) -> syn::Result<proc_macro2::TokenStream> {
    let name = &input.ident;
    let Data::Struct(data) = &input.data else {
        return Err(Error::new_spanned(name, "a type of the contract is a struct"));
    };
    let Fields::Named(fields) = &data.fields else {
        return Err(Error::new_spanned(name, "each field of a type of the contract has a name"));
    };
    if !input.generics.params.is_empty() {
        return Err(Error::new_spanned(
            &input.generics,
            "a type of the contract has no parameters",
        ));
    }
    let fields = fields.named.iter().map(|field| {
        let (field, of) = (&field.ident, &field.ty);
        quote! {
            crate::description::Field {
                name: stringify!(#field),
                offset: ::core::mem::offset_of!(#name, #field),
                kind: <#of as crate::description::Described>::kind(),
            }
        }
    });
    Ok(quote! {
        impl crate::description::Described for #name {
            fn kind() -> crate::description::Kind {
                crate::description::Kind::Type(stringify!(#name))
            }

            fn fields() -> ::std::vec::Vec<crate::description::Field> {
                ::std::vec![#(#fields),*]
            }
        }
    })
}
