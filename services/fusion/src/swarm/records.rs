//! What of a frame's records counts.

use std::collections::BTreeSet;

use flockeye_contract::DetectedMarker;
use flockeye_geometry::search::StopRule;

use crate::assembly::{Frame, Record};
use crate::neighbour::Neighbour;

/// A frame's records in plan order; with the rule `first_hit` those up to the first hit, because
/// what several workers searched beyond it depends on time.
pub fn records_that_count(frame: &Frame, stop_rule: StopRule) -> Vec<&Record> {
    let mut counted = Vec::new();
    for record in frame.records.values() {
        counted.push(record);
        if stop_rule == StopRule::FirstHit && record.header.hits > 0 {
            break;
        }
    }
    counted
}

/// How many different markers of a neighbour were decoded.
pub fn distinct_ids<'m>(
    markers: impl Iterator<Item = &'m DetectedMarker>,
    neighbour: &Neighbour,
) -> u32 {
    let decoded = markers.filter(|marker| marker.is_decoded());
    let ids: BTreeSet<u32> = decoded.map(|marker| marker.id).collect();
    ids.iter().filter(|&&id| neighbour.body.marker(id).is_some()).count() as u32
}
