//! The whole pipeline: real processes, real shared memory, real sessions. One binary, because each
//! would be linked with all of it.

mod ambiguous;
mod bad_input;
mod c_client;
mod calibration;
mod cameras;
mod configurations;
mod conformance;
mod documents;
mod egomotion;
mod evaluation;
mod explaining;
mod faults;
mod foreign;
mod inertial;
mod keeping;
mod lab;
mod lifecycle;
mod lossless;
mod markers;
mod new_stage;
mod played;
mod python;
mod radio;
mod real_time;
mod recorded;
mod recording;
mod replaying;
mod scheduling;
mod secure;
mod service;
mod swapping;
mod swarm;
mod told;
mod view;
mod watching;
