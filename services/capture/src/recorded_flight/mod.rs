//! Recordings of flights as sources.
//!
//! | module | what it does |
//! | --- | --- |
//! | `tape` | reads coded pictures with their stamps, and inertial samples |
//! | `jpeg` | checks a JPEG before it is decoded |
//! | `flight` | decodes the pictures, and adds their stamps and samples |
//! | `clock` | converts the samples to the clock of the playback |

mod clock;
mod flight;
mod jpeg;
mod tape;

pub(crate) use self::clock::FlightClock;
pub(crate) use self::flight::Flight;
