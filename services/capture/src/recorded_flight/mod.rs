//! Recordings of flights as sources.
//!
//! | module | what it does |
//! | --- | --- |
//! | `tape` | reads a recording: coded pictures with their stamps, and samples of the inertial sensor |
//! | `jpeg` | checks a JPEG before it is decoded |
//! | `flight` | decodes the pictures, and gives each its stamp and samples |
//! | `clock` | puts the samples on the clock on which the flight is played |

mod clock;
mod flight;
mod jpeg;
mod tape;

pub(crate) use self::clock::FlightClock;
pub(crate) use self::flight::Flight;
