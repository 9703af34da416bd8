// Square gnomonic views of a spherical camera's image: four pixels for each invocation.
// The same arithmetic as flockeye_imaging::sphere, with the exact mapping at every pixel.

struct Lens {
    // The lens' axes in the camera frame; x is right and y down in the image.
    right: vec3f,
    // Focal length along the image's rows, pixels.
    focal_u: f32,
    down: vec3f,
    // Focal length along the image's columns, pixels.
    focal_v: f32,
    ahead: vec3f,
    // Radians.
    half_field: f32,
    // In the camera frame, metres.
    position: vec3f,
    // Radius of the image circle, pixels.
    circle: f32,
    centre: vec2f,
    curve: u32,
    // Parameter xi of the unified model.
    xi: f32,
    // k1 to k4 of the equidistant curve; xi and alpha of the double sphere; k1, k2, p1, p2 of the
    // unified model.
    coefficients: vec4f,
}

struct Sphere {
    width: u32,
    height: u32,
    // Bytes from one row to the next.
    stride: u32,
    reserved: u32,
    // Equirectangular: half the distance between the lenses, metres.
    offset: f32,
    // Stereographic: twice the paper's R, and the radius of the image circle, pixels.
    plane_scale: f32,
    plane_circle: f32,
    padding: f32,
    lenses: array<Lens, 2>,
}

struct View {
    // Direction of the pixel `start` in the camera frame, in units of the view's pixels.
    direction: vec3f,
    size: u32,
    // Step from a pixel to its right neighbour.
    right: vec3f,
    words_per_row: u32,
    // Step from a pixel to the one below.
    down: vec3f,
    // First word of the view in the output.
    first_word: u32,
    start: vec2i,
    // First workgroup of the view, and number of workgroups side by side.
    first_tile: u32,
    tiles_across: u32,
    // Inverse of the distance at which the view is exact, 1/m.
    nearness: f32,
    // 0: bilinear, 1: cubic.
    interpolation: u32,
    padding: vec2u,
}

struct Batch {
    views: u32,
    tiles: u32,
    reserved: vec2u,
    list: array<View>,
}

@group(0) @binding(0) var<uniform> sphere: Sphere;
@group(0) @binding(1) var<storage, read> batch: Batch;
@group(0) @binding(2) var<storage, read> luma: array<u32>;
@group(0) @binding(3) var<storage, read_write> output: array<u32>;

const PI = 3.14159265358979;

// Camera model, and interpolations of a dispatch's views. Each combination has its own pipeline, so
// that none needs the registers of another.
override model: u32;
override interpolations: u32;

const BILINEAR = 0u;
const CUBIC = 1u;

const EQUIRECTANGULAR = 0u;
const DUAL_FISHEYE = 1u;

const EQUIDISTANT = 0u;
const DOUBLE_SPHERE = 1u;

// Position of a direction that no part of the image sees.
const NOWHERE = vec2i(-2147483647 - 1, 0);

// Abramowitz and Stegun 4.4.49, |t| <= 1. (The built-in atan2 may be off by 4096 units in the last
// place, half a pixel.)
fn atan_unit(t: f32) -> f32 {
    let s = t * t;
    var sum = 0.0028662257;
    sum = sum * s - 0.0161657367;
    sum = sum * s + 0.0429096138;
    sum = sum * s - 0.0752896400;
    sum = sum * s + 0.1065626393;
    sum = sum * s - 0.1420889944;
    sum = sum * s + 0.1999355085;
    sum = sum * s - 0.3333314528;
    return t + t * (sum * s);
}

fn angle(y: f32, x: f32) -> f32 {
    let across = abs(y);
    let along = abs(x);
    let more = max(across, along);
    let first = atan_unit(min(across, along) / select(1.0, more, more > 0.0));
    let quarter = select(first, 0.5 * PI - first, across > along);
    let half_turn = select(quarter, PI - quarter, x < 0.0);
    return select(half_turn, -half_turn, y < 0.0);
}

// To the nearest 1/65536 px.
fn fixed(pixels: vec2f) -> vec2i {
    return vec2i(floor(pixels * 65536.0 + 0.5));
}

fn equirectangular(direction: vec3f, nearness: f32) -> vec2i {
    var seen = direction;
    let offset = sphere.offset * nearness * length(direction);
    if offset > 0.0 {
        // Each lens sees its own side; neither sees the strip between them, which is the seam's.
        seen.x = select(min(seen.x + offset, -1e-30), max(seen.x - offset, 0.0), seen.x >= 0.0);
    }
    let longitude = angle(seen.y, seen.x);
    let latitude = angle(seen.z, length(seen.xy));
    let sides = vec2f(f32(sphere.width), f32(sphere.height));
    let turned = vec2f(longitude / (2.0 * PI), latitude / PI) * sides;
    return fixed(sides * 0.5 - 0.5 - turned);
}

// `direction` as lens `k` sees it, in its own frame.
fn from_lens(k: u32, direction: vec3f, nearness: f32) -> vec3f {
    let from_lens = direction - sphere.lenses[k].position * (nearness * length(direction));
    return vec3f(
        dot(sphere.lenses[k].right, from_lens),
        dot(sphere.lenses[k].down, from_lens),
        dot(sphere.lenses[k].ahead, from_lens),
    );
}

// OpenCV's radial and tangential distortion of a pinhole's point.
fn distorted(plane: vec2f, k: vec4f) -> vec2f {
    let square = dot(plane, plane);
    let radial = 1.0 + square * (k.x + square * k.y);
    let tangential = vec2f(k.w, k.z) * (square + 2.0 * plane * plane)
        + 2.0 * vec2f(k.z, k.w) * plane.x * plane.y;
    return plane * radial + tangential;
}

fn through_lens(k: u32, seen: vec3f) -> vec2i {
    let across = length(seen.xy);
    let off_axis = angle(across, seen.z);
    if off_axis > sphere.lenses[k].half_field {
        return NOWHERE;
    }
    let coefficients = sphere.lenses[k].coefficients;
    var scale: f32;
    if sphere.lenses[k].curve == EQUIDISTANT {
        let square = off_axis * off_axis;
        let further = coefficients.y + square * (coefficients.z + square * coefficients.w);
        let stretch = 1.0 + square * (coefficients.x + square * further);
        if across > 0.0 {
            scale = off_axis * stretch / across;
        }
    } else if sphere.lenses[k].curve == DOUBLE_SPHERE {
        let distance = length(seen);
        let ahead = coefficients.x + seen.z / distance;
        let further = length(vec2f(across / distance, ahead));
        scale = 1.0 / (distance * mix(ahead, further, coefficients.y));
    } else {
        scale = 1.0 / (sphere.lenses[k].xi * length(seen) + seen.z);
    }
    var plane = seen.xy * scale;
    if sphere.lenses[k].curve > DOUBLE_SPHERE {
        plane = distorted(plane, coefficients);
    }
    let focal = vec2f(sphere.lenses[k].focal_u, sphere.lenses[k].focal_v);
    let from_centre = plane * focal;
    if length(from_centre) > sphere.lenses[k].circle {
        return NOWHERE;
    }
    return fixed(sphere.lenses[k].centre + from_centre);
}

fn dual_fisheye(direction: vec3f, nearness: f32) -> vec2i {
    let one = from_lens(0u, direction, nearness);
    let other = from_lens(1u, direction, nearness);
    // The lens whose axis is nearer; the other one where that does not see it.
    if other.z * length(one) > one.z * length(other) {
        let at = through_lens(1u, other);
        if at.x != NOWHERE.x {
            return at;
        }
        return through_lens(0u, one);
    }
    let at = through_lens(0u, one);
    if at.x != NOWHERE.x {
        return at;
    }
    return through_lens(1u, other);
}

fn stereographic(direction: vec3f) -> vec2i {
    let long = length(direction);
    // 1 / (long + x), which loses its digits behind the camera; there the square of what is across
    // is long^2 - x^2.
    var inverse: f32;
    if direction.x > 0.0 {
        inverse = 1.0 / (long + direction.x);
    } else {
        inverse = (long - direction.x) / dot(direction.yz, direction.yz);
    }
    let from_centre = -direction.yz * (inverse * sphere.plane_scale);
    // Infinite, or not a number, straight behind.
    if !(length(from_centre) <= sphere.plane_circle) {
        return NOWHERE;
    }
    let sides = vec2f(f32(sphere.width), f32(sphere.height));
    return fixed(from_centre + 0.5 * (sides - 1.0));
}

// Column and row, 1/65536 px.
fn position(direction: vec3f, nearness: f32) -> vec2i {
    if model == EQUIRECTANGULAR {
        return equirectangular(direction, nearness);
    }
    if model == DUAL_FISHEYE {
        return dual_fisheye(direction, nearness);
    }
    return stereographic(direction);
}

// The byte of a pixel that may lie beyond the image. An equirectangular one goes round: rows beyond
// the poles come back half a turn further. Others end with their last pixels.
fn place(at: vec2i) -> u32 {
    let width = i32(sphere.width);
    let height = i32(sphere.height);
    var column = at.x;
    var row = at.y;
    if model == EQUIRECTANGULAR {
        if row < 0 || row >= height {
            row = select(2 * height - 1 - row, -1 - row, row < 0);
            column += width / 2;
        }
        column += select(0, width, column < 0);
        column -= select(0, width, column >= width);
    }
    column = clamp(column, 0, width - 1);
    row = clamp(row, 0, height - 1);
    return u32(row) * sphere.stride + u32(column);
}

fn pixel(at: vec2i) -> i32 {
    let place = place(at);
    return i32((luma[place >> 2u] >> (8u * (place & 3u))) & 0xffu);
}

// Four neighbouring pixels of a row; `is_inside` says that all lie in the image.
fn four(at: vec2i, is_inside: bool) -> vec4i {
    if is_inside {
        let first = u32(at.y) * sphere.stride + u32(at.x);
        let shift = 8u * (first & 3u);
        // A shift by all 32 places would be one by none. The second word of a pixel that ends with
        // the first counts for nothing: it may lie beyond the buffer, which reads as anything.
        let word = (luma[first >> 2u] >> shift) | ((luma[(first >> 2u) + 1u] << (31u - shift)) << 1u);
        return vec4i((vec4u(word) >> vec4u(0u, 8u, 16u, 24u)) & vec4u(0xffu));
    }
    return vec4i(
        pixel(at),
        pixel(at + vec2i(1, 0)),
        pixel(at + vec2i(2, 0)),
        pixel(at + vec2i(3, 0)),
    );
}

// The arithmetic of flockeye_imaging's sample.rs.
fn bilinear(at: vec2i) -> u32 {
    let first = at >> vec2u(16u);
    // Greys less 128. (Words would be as many loads as these.)
    let above = vec2i(pixel(first), pixel(first + vec2i(1, 0))) - 128;
    let below = vec2i(pixel(first + vec2i(0, 1)), pixel(first + vec2i(1, 1))) - 128;
    let right = (at.x >> 8u) & 0xff;
    let down = at.y & 0xffff;
    let upper = (255 - right) * above.x + right * above.y;
    let lower = (255 - right) * below.x + right * below.y;
    let upper_weight = ((0xffff - down) * 16450) >> 16u;
    let lower_weight = (down * 16450) >> 16u;
    return u32((upper * upper_weight + lower * lower_weight + 538968064) >> 22u);
}

fn product(a: i32, b: i32) -> i32 {
    return (a * b + 16384) >> 15u;
}

fn cubic_weights(fraction: i32) -> vec4i {
    let t = (fraction & 0xffff) >> 1u;
    let square = product(t, t);
    let cube = product(square, t);
    let first = (2 * square - cube - t) >> 2u;
    let second = 16384 + ((3 * (cube - square)) >> 2u) - (square >> 1u);
    let last = (cube - square) >> 2u;
    return vec4i(first, second, 16384 - first - second - last, last);
}

// The arithmetic of flockeye_imaging's cubic.rs.
fn cubic(at: vec2i) -> u32 {
    let first = (at >> vec2u(16u)) - 1;
    let sides = vec2i(i32(sphere.width), i32(sphere.height));
    let inside = all(first >= vec2i(0)) && all(first + 3 < sides);
    let across = cubic_weights(at.x);
    let along = cubic_weights(at.y);
    var rows: vec4i;
    rows.x = dot(four(first, inside), across);
    rows.y = dot(four(first + vec2i(0, 1), inside), across);
    rows.z = dot(four(first + vec2i(0, 2), inside), across);
    rows.w = dot(four(first + vec2i(0, 3), inside), across);
    let grey = (dot((rows + 128) >> vec4u(8u), along) + 524288) >> 20u;
    return u32(clamp(grey, 0, 255));
}

// The last view whose first workgroup is not behind `tile`.
fn view_of(tile: u32) -> u32 {
    var low = 0u;
    var high = batch.views;
    while high - low > 1u {
        let middle = (low + high) / 2u;
        if batch.list[middle].first_tile <= tile {
            low = middle;
        } else {
            high = middle;
        }
    }
    return low;
}

@compute @workgroup_size(8, 8)
fn rectify(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_id) local: vec3u,
) {
    let tile = group.y * groups.x + group.x;
    if tile >= batch.tiles {
        return;
    }
    let view = batch.list[view_of(tile)];
    let place = tile - view.first_tile;
    let column = 8u * (place % view.tiles_across) + local.x;
    let row = 8u * (place / view.tiles_across) + local.y;
    if column >= view.words_per_row || row >= view.size {
        return;
    }
    var word = 0u;
    for (var k = 0u; k < 4u; k += 1u) {
        let step = vec2f(vec2i(i32(4u * column + k), i32(row)) - view.start);
        let direction = view.direction + step.x * view.right + step.y * view.down;
        let at = position(direction, view.nearness);
        var grey = 0u;
        if at.x != NOWHERE.x {
            if interpolations == CUBIC || (interpolations != BILINEAR && view.interpolation == CUBIC) {
                grey = cubic(at);
            } else {
                grey = bilinear(at);
            }
        }
        word |= grey << (8u * k);
    }
    output[view.first_word + row * view.words_per_row + column] = word;
}
