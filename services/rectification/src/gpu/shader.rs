//! The shader: a pipeline for each camera model and kind of batch.

use flockeye_geometry::camera::{Camera, CameraModel};
use flockeye_imaging::sphere::{Cut, Interpolation};
use wgpu::{BindGroupLayout, BufferBindingType, ComputePipeline, ShaderStages};

/// Pipelines of the shader by camera model and interpolations, and the layout of their bindings.
#[derive(Debug)]
pub(super) struct Shader {
    pub bindings: BindGroupLayout,
    pipelines: [[ComputePipeline; 3]; 3],
}

impl Shader {
    pub(super) fn new(device: &wgpu::Device) -> Self {
        let storage = |read_only| BufferBindingType::Storage { read_only };
        let types = [BufferBindingType::Uniform, storage(true), storage(true), storage(false)];
        let entries: Vec<_> = (0..)
            .zip(types)
            .map(|(binding, ty)| wgpu::BindGroupLayoutEntry {
                binding,
                visibility: ShaderStages::COMPUTE,
                ty: wgpu::BindingType::Buffer {
                    ty,
                    has_dynamic_offset: false,
                    min_binding_size: None,
                },
                count: None,
            })
            .collect();
        let bindings = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: None,
            entries: &entries,
        });
        let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            bind_group_layouts: &[Some(&bindings)],
            ..Default::default()
        });
        let module = device.create_shader_module(wgpu::include_wgsl!("rectify.wgsl"));
        let pipeline = |model: u32, interpolations: u32| {
            device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some("rectify"),
                layout: Some(&layout),
                module: &module,
                entry_point: Some("rectify"),
                compilation_options: wgpu::PipelineCompilationOptions {
                    constants: &[
                        ("model", f64::from(model)),
                        ("interpolations", f64::from(interpolations)),
                    ],
                    ..Default::default()
                },
                cache: None,
            })
        };
        let pipelines = [0, 1, 2].map(|model| [0, 1, 2].map(|kind| pipeline(model, kind)));
        Self { bindings, pipelines }
    }

    /// The pipeline for frames of a camera and the interpolations of `cuts`.
    pub(super) fn pipeline(&self, camera: &Camera, cuts: &[Cut]) -> &ComputePipeline {
        // Numbers of the models as in the shader.
        let model = match camera.model() {
            CameraModel::Equirectangular { .. } => 0,
            CameraModel::DualFisheye(_) => 1,
            CameraModel::Stereographic { .. } => 2,
        };
        let is_cubic = |cut: &Cut| cut.interpolation == Interpolation::Cubic;
        let interpolations = match (cuts.iter().any(is_cubic), cuts.iter().all(is_cubic)) {
            (false, _) => 0,
            (true, true) => 1,
            (true, false) => 2,
        };
        &self.pipelines[model][interpolations]
    }
}
