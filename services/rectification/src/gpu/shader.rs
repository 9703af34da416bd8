//! The shader: a pipeline for each camera model.

use flockeye_geometry::camera::{Camera, CameraModel};
use wgpu::{BindGroupLayout, BufferBindingType, ComputePipeline, ShaderStages};

/// The shader's pipelines, by the model, and how buffers are bound to them.
#[derive(Debug)]
pub(super) struct Shader {
    pub bindings: BindGroupLayout,
    pipelines: [ComputePipeline; 3],
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
        let pipeline = |model: u32| {
            device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some("rectify"),
                layout: Some(&layout),
                module: &module,
                entry_point: Some("rectify"),
                compilation_options: wgpu::PipelineCompilationOptions {
                    constants: &[("model", f64::from(model))],
                    ..Default::default()
                },
                cache: None,
            })
        };
        Self { bindings, pipelines: [0, 1, 2].map(pipeline) }
    }

    /// The pipeline for frames of a camera.
    pub(super) fn pipeline(&self, camera: &Camera) -> &ComputePipeline {
        // As the shader counts them.
        let model = match camera.model() {
            CameraModel::Equirectangular { .. } => 0,
            CameraModel::DualFisheye(_) => 1,
            CameraModel::Stereographic { .. } => 2,
        };
        &self.pipelines[model]
    }
}
