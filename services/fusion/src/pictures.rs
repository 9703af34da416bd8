//! Views that are held, as images to be aligned with.

use flockeye_contract::{ViewHeader, Views};
use flockeye_convert::{RadianceCache, image_of, view_of};
use flockeye_geometry::search::Purpose;
use flockeye_imaging::align::Picture;
use flockeye_runtime::ports::Message;

use crate::alignment::BestView;
use crate::gallery::{FrameOrder, Gallery};
use crate::message::purpose_stated;
use crate::swarm::{BestViews, Glimpse, Swarm};

/// The best views of a frame's neighbours, as images. What cannot be read is left out: detection
/// says why.
pub fn best_views<'g>(
    gallery: &'g Gallery<Message<Views>>,
    lights: &'g mut RadianceCache,
    swarm: &Swarm,
    order: FrameOrder,
) -> BestViews<'g> {
    for (_, header, _) in gallery.of_frame(order) {
        // Known from here on, or refused here and again below.
        let _ = lights.of(header);
    }
    let lights = &*lights;
    gallery
        .of_frame(order)
        .filter_map(|(target, header, message)| {
            Some((target, best_view(header, message, lights, swarm)?))
        })
        .collect()
}

/// Those of a frame's views that were cut for a neighbour and wait to be searched, with their headers. What
/// cannot be read is left to detection, which says why.
pub fn glimpses<'g>(
    gallery: &'g Gallery<Message<Views>>,
    lights: &'g mut RadianceCache,
    swarm: &Swarm,
    views: &[(FrameOrder, u32)],
) -> Vec<(ViewHeader, Glimpse<'g>)> {
    let waiting = || views.iter().filter_map(|&(order, index)| gallery.waiting(order, index));
    for (header, _) in waiting() {
        let _ = lights.of(header);
    }
    let lights = &*lights;
    waiting()
        .filter_map(|(header, message)| {
            let Some(Purpose::Gaze(target)) = purpose_stated(header) else { return None };
            let view = best_view(header, message, lights, swarm)?;
            Some((*header, Glimpse { target, view }))
        })
        .collect()
}

/// A view as an image; `None` where it cannot be read.
fn best_view<'g>(
    header: &ViewHeader,
    message: &'g Message<Views>,
    lights: &'g RadianceCache,
    swarm: &Swarm,
) -> Option<BestView<'g>> {
    let picture = Picture {
        image: image_of(header, message.items()).ok()?,
        view: view_of(header),
        light: lights.known(header)?,
        pixels_per_radian: swarm.pixels_per_radian(),
    };
    Some(BestView { picture, view_index: header.view_index, rays_m: swarm.rays_m(header) })
}
