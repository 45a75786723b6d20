#pragma once
#include <string>

namespace refdgs::cuda {

// The first GPU's name, or "" with no driver or no device. Never throws.
std::string device_name();

}  // namespace refdgs::cuda
