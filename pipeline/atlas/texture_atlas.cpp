#include "pipeline/atlas/texture_atlas.h"
namespace booth { Result<TextureAtlas> build_texture_atlas(const Mesh&, const Rig&, std::span<const Frame>, std::span<const Silhouette>, const AtlasOptions&, const Work&) { return Error{ErrorCode::unsupported, "pending"}; } }
